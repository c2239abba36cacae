"""Adaptation from Python: what `cuelearner adapt` does. The result is a policy to call."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax

from cuelearner_jax import user_code
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.adaptation.lanes import blame
from cuelearner_jax.api import arguments
from cuelearner_jax.api.feedback import Labels, check_settings, divergence_error, label_path, labels_of, rows_of
from cuelearner_jax.api.policies import CallablePolicy, as_policy, as_policy_in, source_of
from cuelearner_jax.api.worlds import World
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.reading import Estimate, Result
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import label_files, policy_folders
from cuelearner_jax.studies import adapt as study
from cuelearner_jax.studies.adapt import AdaptedStudy, BaseLanes, Subject
from cuelearner_jax.task import Body, Task
from cuelearner_jax.types import Label, Teacher


@dataclasses.dataclass(frozen=True, kw_only=True)
class AdaptedPolicy(CallablePolicy):
    """A corrected policy: its base under a feedback model within a bound, or corrected for estimated changes.

    Where `used` is False, it acts as its base.
    """

    outcome: AdaptedStudy
    named: str | None  # the base, as Python calls it; None: its world has no name either

    @property
    def used(self) -> bool:
        """Whether the correction is used. It is only if it is shown to be better."""
        return bool(self.outcome.found.judged.used[0])

    @property
    def judged(self) -> tuple[str, float, float]:
        """The metric's name, and its value before and after the correction, on tuning episodes or held-out labels."""
        of = self.outcome.found.judged
        return of.by, float(of.before[0]), float(of.after[0])

    @property
    def difference(self) -> tuple[float, float, float]:
        """The metric after less before, and its 95% interval over the tuning episodes; NaN where labels judge."""
        estimate, lower, upper = (float(value) for value in self.outcome.found.judged.difference[0])
        return estimate, lower, upper

    @property
    def rewarded_steps(self) -> int:
        """Number of environment steps whose rewards decided whether the correction is used; 0 where labels judge."""
        return int(self.outcome.found.judged.rewarded_steps[0])

    @property
    def labels(self) -> Labels:
        """The labels so far (relative feedback)."""
        return labels_of(jax.tree.map(lambda leaf: leaf[0], self.outcome.found.labels))

    @property
    def result(self) -> Result | None:
        """The verdict of a reading and its estimates with intervals. None where a feedback model was fitted."""
        return next(iter(self.outcome.found.results), None)

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """A reading's estimates (name, unit, mean, low, high). Empty where a feedback model was fitted."""
        return self.result.estimates if self.result else ()

    @property
    def words(self) -> list[str]:
        """The lines that `cuelearner adapt` prints of this result."""
        return study.sentences(self.outcome.found)

    @user_code.report_user_errors
    def save(self, folder: str | Path, overwrite: bool = False) -> None:
        """Write a policy folder, as `cuelearner adapt` does. `load_policy` and every command read it.

        Raises UserError if the folder is in use, or the policy was adapted in no world that can be named.
        """
        folder = arguments.path("folder", folder)
        arguments.flag("overwrite", overwrite)
        if folder.exists() and not folder.is_dir():
            raise UserError(f"folder {folder} is a file: give the path of a folder")
        if self.named is None:
            raise UserError(
                "a policy folder names the world of its policy, and this policy was adapted in a "
                "bare environment: adapt in a world from cl.make"
            )
        with policy_folders.place_of(folder, overwrite) as place:
            self.outcome._replace(origin={"code": self.named}).write(place)


@user_code.report_user_errors
def adapt(
    policy: Any,
    world: World | Environment,
    teacher: Teacher | Any = None,
    *,
    labels: int | Labels | str | os.PathLike[str] | None = None,
    bound_deg: float | None = None,
    eps_deg: float | None = None,
    guidance: str | None = None,
    sizes: GuideSizes | None = None,
    scalars: Scalars | None = None,
    seed: int = 0,
    judge_by: str | None = None,
    judge_episodes: int = 50,
    judge_bounds: Sequence[float] | None = None,
    changes: Any = None,
) -> AdaptedPolicy:
    """Correct a finished policy by labels about its actions in a (changed) world, as `cuelearner adapt` does.

    Labels are asked for in rounds, about actions refined by the model so far (DAgger), within a bound of the policy's
    own. A correction that is not shown to make the policy better is not used, with a warning.
    Arguments that are left out follow the world's scenario, else the defaults of `cuelearner adapt`.

    Args:
        policy: the policy to correct: a policy, or any function of a batch of observations (NumPy in, NumPy out; one
            that `jax.jit` made is compiled in).
        world: the world that the policy acts in; a bare environment will do.
        teacher: a teacher; or a function of observations (NumPy in, NumPy out) or another policy, which teaches what
            it does itself; None where labels are given.
        labels: number of questions (default: 100 of a reading, else 500); or labels that are there already: arrays,
            or a label file.
        bound_deg: how far corrections may lead from the policy's own actions [deg] (default: the scenario's, of labels
            that are there already as far as they reach, or else 45).
        eps_deg: strength of an answer [deg] (default: as labels, scenario or training had it).
        guidance: kind of guidance: what is asked, and what a model makes of it (default: the scenario's or "reading").
        sizes: sizes of the network, of its fitting, and of a round of labels.
        scalars: settings of fitting, of refinement and of the teacher's faults.
        seed: seed of all random numbers.
        judge_by: the metric by which it is judged, or "labels": by the prediction of held-out ones (default: the
            scenario's or the task's; of a reading "labels").
        judge_episodes: number of tuning episodes, each of 100 steps where the task does not count episodes.
        judge_bounds: shares of the bound, such as (0.5, 0.25), within which the model is tried on these episodes too;
            it is used within what is worth most (default: the scenario's, or none).
        changes: for guidance "reading", the possible changes, as `Distortion`s of your own, or a function of the
            environment that returns them (default: what the world declares).

    Raises:
        UserError: settings that make no sense, or with which the fit diverges.
    """
    source = _source(policy, world)
    env = world.env if isinstance(world, World) else world
    space = actions_of(env)
    sizes, scalars, eps_deg = check_settings(space, sizes, scalars, eps_deg)
    guidance, judge_by = (
        arguments.optional(arguments.text, name, value)
        for name, value in (("guidance", guidance), ("judge_by", judge_by))
    )
    count, file, rows = _given(labels, world)
    scenario = world.scenario if isinstance(world, World) else None
    request = study.suggested(source, scenario, guidance, judge_by, file, eps_deg, sizes, scalars)
    asked = {
        "labels": None if count is None else (count,),
        "bound_deg": None if bound_deg is None else (arguments.amount("bound_deg", bound_deg, space),),
        "judge_bounds": arguments.optional(_shares, "judge_bounds", judge_bounds),
    }
    request = dataclasses.replace(
        request,
        task=source.config.task,
        first_seed=arguments.seed("seed", seed),
        judge_episodes=arguments.whole("judge_episodes", judge_episodes, 1, study.MOST_ENVS),
        **{name: value for name, value in asked.items() if value is not None},
    )
    own = as_policy_in(policy, env)
    if teacher is not None:
        teacher = arguments.teacher("teacher", teacher, space)
        user_code.answers_in("teacher", teacher, env)
    elif file is None and rows is None:
        raise UserError(
            "teacher is None: give one, for instance teacher=cl.teacher_of(world), or labels as arrays or a file"
        )
    subject = Subject(source, BaseLanes(source.default_policy), own, teacher=teacher, rows=rows, changes=changes)
    outcome = study.run(subject, request, note=partial(warnings.warn, stacklevel=5))
    if outcome.found.failed.any():
        blame(outcome.found.of, teacher, outcome.found.block)
        raise divergence_error()
    if not outcome.found.judged.used.all():
        warnings.warn(study.sentences(outcome.found)[-1], stacklevel=3)
    adapted = outcome.found.policy(env).lane(0)
    named = _called(policy) if isinstance(world, World) else None
    trained = RunConfig(source.config.task)
    observation = getattr(env, "observation", ())
    where = world if isinstance(world, World) else None
    told = {"trained": trained, "actions": space, "world": where}
    return AdaptedPolicy(adapted, observation, **told, outcome=outcome, named=named)


def _source(policy: Any, world: Any) -> PolicySource:
    """Return a world's task and the configuration of its training. Raises UserError for an object that is no world."""
    if isinstance(world, World):
        return source_of(policy, world)
    if hasattr(world, "observation_space"):
        raise UserError("world is an environment of Gymnasium: give cl.from_gymnasium(its id, class or function)")
    if isinstance(world, type) or not all(callable(getattr(world, name, None)) for name in ("reset", "step")):
        raise arguments.argument_error("world", world, "a world, as cl.make gives it, or an environment")
    task = Task("environment", "a bare environment", _Bare, (Body("own", "", lambda config, split: world),))
    config = getattr(policy, "trained", None) or RunConfig(_Bare(), scalars=plain_scalars(actions_of(world)))
    return PolicySource(task, config, None, Path(task.name))


@dataclasses.dataclass(frozen=True)
class _Bare:
    """The empty configuration of a bare environment."""


def _given(labels: Any, world: Any) -> tuple[int | None, Path | None, Label | None]:
    """Return labels as a number of questions, as a file, or as rows (labels, ...). Raises UserError for others."""
    if isinstance(labels, str | os.PathLike):
        path = label_path(labels)
        if isinstance(world, World):
            return None, path, None
        return None, None, label_files.read(path).labels  # a bare environment has no name that a file could hold
    if labels is None:
        return None, None, None
    if not isinstance(labels, tuple):
        return arguments.budget("labels", labels), None, None
    return None, None, rows_of(labels)


def _shares(name: str, given: Any) -> tuple[float, ...]:
    wanted = "shares of the bound below 1"
    return tuple(arguments.number(name, bound, 1.0, wanted) for bound in arguments.several(name, given, wanted))


def _called(policy: Any) -> str:
    """Return a policy's name in Python."""
    inner = as_policy(policy)
    inner = getattr(inner, "function", inner)
    name = getattr(inner, "__qualname__", type(inner).__qualname__)
    return f"{getattr(inner, '__module__', type(inner).__module__)}:{name}"
