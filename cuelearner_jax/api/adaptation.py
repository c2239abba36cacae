"""Adaptation from Python: what `cuelearner adapt` does. The result is a policy to call.

`adapt` asks about actions in a world, `correct` takes labels alone, without simulator or task; `agreement` counts how
many other answers a policy agrees with.
"""

from __future__ import annotations

import dataclasses
import math
import os
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from cuelearner_jax import user_code
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.adaptation.judging import LABELS, PERSON, Prefer
from cuelearner_jax.adaptation.lanes import blame
from cuelearner_jax.api.labels import Labels, labels_from_file, labels_of, rows_of
from cuelearner_jax.api.policies import CallablePolicy, as_policy, as_policy_in, config_of, load_policy
from cuelearner_jax.api.worlds import World, numbers, teacher_of_world, world_around
from cuelearner_jax.config import GuideSizes, Scalars, from_json, normalize_options
from cuelearner_jax.environment import Environment, Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.base import ReadingGuide
from cuelearner_jax.policies import ONNX, Common, innermost, policy_of
from cuelearner_jax.policies.user import Foreign
from cuelearner_jax.reading import Estimate, Result
from cuelearner_jax.spaces import DIRECTIONS, Box, Space, cues_from
from cuelearner_jax.storage import policy_folders
from cuelearner_jax.storage.label_files import LabelFile
from cuelearner_jax.studies.adapt import AdaptedStudy, AdaptRequest, Subject
from cuelearner_jax.studies.evaluate import Agreement
from cuelearner_jax.studies.evaluate import agreement as agreement_of
from cuelearner_jax.tasks import logs
from cuelearner_jax.tasks.logs import LogsConfig
from cuelearner_jax.types import Teacher


@dataclasses.dataclass(frozen=True, kw_only=True, repr=False)
class AdaptedPolicy(CallablePolicy):
    """A corrected policy: its base under a feedback model within a bound, or corrected for estimated changes.

    Where `used` is False, it acts as its base.
    """

    outcome: AdaptedStudy

    @property
    def used(self) -> bool:
        """Whether the correction is used. It is only if it is shown to be better."""
        return bool(self.outcome.result.judgement.in_use[0])

    @property
    def judged(self) -> tuple[str, float, float]:
        """The metric's name, and its value before and after the correction, on tuning episodes or held-out labels."""
        of = self.outcome.result.judgement
        return of.by, float(of.before[0]), float(of.after[0])

    @property
    def difference(self) -> tuple[float, float, float]:
        """The metric after less before, and its 95% interval over the tuning episodes; NaN where labels judge."""
        estimate, lower, upper = (float(value) for value in self.outcome.result.judgement.difference[0])
        return estimate, lower, upper

    @property
    def rewarded_steps(self) -> int:
        """Number of environment steps whose rewards decided whether the correction is used; 0 where labels judge."""
        return int(self.outcome.result.judgement.rewarded_steps[0])

    @property
    def labels(self) -> Labels:
        """The labels so far (relative feedback)."""
        return labels_of(jax.tree.map(lambda leaf: leaf[0], self.outcome.result.labels))

    @property
    def result(self) -> Result | None:
        """The verdict of a reading and its estimates with intervals. None where a feedback model was fitted."""
        return next(iter(self.outcome.result.results), None)

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """A reading's estimates (name, unit, mean, low, high). Empty where a feedback model was fitted."""
        return self.result.estimates if self.result else ()

    @property
    def words(self) -> list[str]:
        """The lines that `cuelearner adapt` prints of this result."""
        return self.outcome.result.words

    @user_code.report_user_errors
    def save(self, folder: str | Path, overwrite: bool = False) -> None:
        """Write a policy folder, as `cuelearner adapt` does. `load_policy` and every command read it.

        Raises UserError if the folder is in use, or the policy was adapted in no world that can be named.
        """
        if self.world is None:
            raise UserError("a policy folder names its world, and an environment has no name: adapt in one of cl.make")
        base = innermost(self.outcome.subject.bases.policy)
        base = getattr(base, "function", base)
        name = getattr(base, "__qualname__", type(base).__qualname__)  # of a foreign policy its file
        origin = {"code": name if isinstance(base, Foreign) else f"{base.__module__}:{name}"}
        subject = self.outcome.subject._replace(origin=origin)
        with policy_folders.place_of(Path(folder), overwrite) as place:
            self.outcome._replace(subject=subject).write(place)


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
    judge_by: str | Prefer | None = None,
    judge_episodes: int = 50,
    judge_bounds: Sequence[float] | None = None,
    changes: Any = None,
) -> AdaptedPolicy:
    """Correct a finished policy by labels about its actions in a (changed) world, as `cuelearner adapt` does.

    Labels are asked for in rounds, about actions refined by the model so far (DAgger), within a bound of the policy's
    own. A correction that is not shown to make the policy better is not used, with a warning.
    Arguments that are left out follow the world's scenario, else the defaults of `cuelearner adapt`.

    Args:
        policy: a policy, or any function of a batch of observations (NumPy in, NumPy out; one of `jax.jit` is compiled
            in).
        world: the world that the policy acts in; a bare environment will do.
        teacher: a teacher; or a function or a policy, which teaches what it does itself; None where labels are given.
        labels: number of questions (default: 100 of a reading, else 500); or labels: arrays, or a label file.
        bound_deg: how far corrections may lead from the policy's own actions [deg] (default: the scenario's; of a
            reading none; else as far as given labels reach, or 45).
        eps_deg: strength of an answer [deg] (default: as labels, scenario or training had it).
        guidance: kind of guidance (default: the scenario's or "reading").
        sizes, scalars: settings of the model and its fitting, of refinement and of the teacher's faults.
        seed: seed of all random numbers.
        judge_by: a metric (more is better), or "labels" (default: the scenario's or the task's; of a reading "labels").
            Or a function of two films (.gif) of one start: -1 where the left one is better, 1 the right one, else 0.
        judge_episodes: number of tuning episodes, each of 100 steps where the task does not count episodes.
        judge_bounds: shares of the bound, such as (0.5, 0.25), within which the model is tried on these episodes too;
            it is used within what is worth most (default: the scenario's, or none).
        changes: for "reading", the possible changes: `Distortion`s of your own, or a function of the environment that
            returns them (default: what the world declares).
    """
    if hasattr(world, "observation_space"):
        raise UserError("world is an environment of Gymnasium: give cl.from_gymnasium(its id, class or function)")
    own_world = world if isinstance(world, World) else world_around(world)
    env, task, config = own_world.env, own_world.task, config_of(policy, own_world)
    file = Path(labels) if isinstance(labels, str | os.PathLike) else None
    rows = rows_of(labels) if isinstance(labels, tuple) else None
    if teacher is not None and (file is not None or rows is not None):
        raise UserError("labels answer in place of a teacher: give teacher or labels, not both")
    if teacher is not None:
        teacher = teacher_of_world(teacher, own_world.actions)
    elif file is None and rows is None:
        raise UserError("teacher is None: give one, for instance teacher=cl.teacher_of(world), or labels")
    prefer, judge_by = (judge_by, PERSON) if callable(judge_by) else (None, judge_by)
    request = AdaptRequest.of(task, config, own_world.scenario, guidance, judge_by, file, eps_deg, scalars)
    options: dict[str, Any] = {
        "task": own_world.config,  # the scenario's, with the caller's options on top
        "labels": request.labels if labels is None or isinstance(labels, str | os.PathLike | tuple) else (labels,),
        "bound_deg": request.bound_deg if bound_deg is None else (bound_deg,),
        "judge_bounds": request.judge_bounds if judge_bounds is None else tuple(judge_bounds),
        "sizes": normalize_options(sizes or request.sizes, "sizes"),
        "scalars": normalize_options(request.scalars, "scalars"),
    }
    request = dataclasses.replace(request, **options, seeds=f"{seed}:{seed + 1}", judge_episodes=judge_episodes)
    bases = Common(as_policy_in(policy, env))
    outcome = request.run(Subject(task, env, bases, teacher=teacher, rows=rows, changes=changes, prefer=prefer))
    result = outcome.result
    if result.failed.any():
        blame(result.of, teacher, result.block)
        raise UserError("the fit of the feedback model diverged: lower scalars.feedback_learning_rate")
    if not result.judgement.in_use.all():
        warnings.warn(result.words[-1], stacklevel=3)
    about = {"trained": config, "actions": own_world.actions, "world": world if own_world is world else None}
    return AdaptedPolicy(result.policy(env).lane(0), getattr(env, "observation", ()), **about, outcome=outcome)


@user_code.report_user_errors
def correct(
    policy: Any,
    labels: Labels | str | os.PathLike[str],
    *,
    bound: float | None = None,
    eps: float | None = None,
    guidance: str = ReadingGuide.name,
    cues: str | Sequence[Any] = "",
    low: Sequence[float] | np.ndarray | None = None,
    high: Sequence[float] | np.ndarray | None = None,
    space: Space | None = None,
    changes: Any = None,
    sizes: GuideSizes | None = None,
    scalars: Scalars | None = None,
    seed: int = 0,
) -> AdaptedPolicy:
    """Correct a policy by relative labels, as `cuelearner adapt --labels-from` does, without a task.

    Every fifth answer is held out; a model that predicts no more of these than "already right" always is not used,
    with a warning.

    Args:
        policy: a function of a batch of observations, a module of PyTorch, a model of Stable-Baselines3, the path of a
            file in ONNX or of a folder of ours, or a policy.
        labels: `Labels(observations, actions, answers)` as arrays, or a label file.
        bound: how far corrections may lead from the policy's own actions, in shares of the range of each entry, or the
            space's unit (default: of a reading none, else as far as the labels reach).
        eps: strength of an answer, in the same unit (default: the file's, or 1/36 of the range).
        guidance: how answers are used: "reading" finds what changed, "relative" fits a network.
        cues: words for more and less of each entry of an action, "left,right;up,down" (default: "more,less").
        low, high: bounds of the actions, a number an entry (default: the range of the labels' actions).
        space: the space of the actions, such as `cuelearner_jax.spaces.DIRECTIONS`, in place of cues, low and high.
        changes, sizes, scalars, seed: as for `adapt`.
    """
    if isinstance(policy, str | os.PathLike) and not str(policy).endswith(ONNX):
        policy = load_policy(policy)
    before = getattr(getattr(policy, "trained", None), "task", None)
    before = before if isinstance(before, LogsConfig) else None
    is_file = isinstance(labels, str | os.PathLike)
    says_space = is_file or any(one is not None for one in (cues or None, low, high, before))
    if space is None and not says_space and isinstance(policy, CallablePolicy) and policy.observation:
        space = policy.actions
    file = _labels(labels, space, cues, low, high, before)
    if eps is not None and file.eps is not None and not math.isclose(eps, file.eps, rel_tol=1e-6):
        raise UserError(f"the label file holds answers of {file.eps:g} {file.space.unit}: leave out eps")
    acting = CallablePolicy(policy_of(as_policy(policy), file.space), actions=file.space)
    acting(file.labels.obs)  # refuses what gives no actions
    return adapt(
        policy if isinstance(policy, CallablePolicy) else acting,
        world_of(file, before),
        labels=labels_of(file.labels),
        bound_deg=bound,
        eps_deg=eps if file.eps is None else file.eps,
        guidance=guidance,
        sizes=sizes,
        scalars=scalars,
        seed=seed,
        judge_by=LABELS,
        changes=changes,
    )


@user_code.report_user_errors
def agreement(
    policy: Any,
    labels: Labels | str | os.PathLike[str],
    *,
    base: Any = None,
    eps: float | None = None,
    space: Space | None = None,
) -> Agreement:
    """Return how many answers a policy agrees with, beside its base and "already right" always.

    Args:
        policy: any policy that `correct` takes or returns.
        labels: answers that the policy was not corrected by, as `correct` takes them.
        base: the policy as it was (default: what a corrected policy corrects).
        eps: strength of an answer (default: the file's, that of `correct` or `adapt`, or of a policy that was not
            corrected 1/36 of the range).
        space: space of the actions (default: the file's, or that of the corrected policy).
    """
    own = as_policy(policy)
    if space is None and not isinstance(labels, str | os.PathLike):
        if not isinstance(policy, CallablePolicy):
            raise UserError("space is None, and arrays of labels name none: give space=, or a label file")
        space = policy.actions
    file = _labels(labels, space)
    if eps is None and (eps := file.eps) is None:
        scalars = getattr(policy.outcome.request if isinstance(policy, AdaptedPolicy) else own, "scalars", None)
        if scalars is None and getattr(own, "base", None) is not None:
            raise UserError("eps is None, and a loaded reading no longer knows how strong its answers were: give eps=")
        eps = float((scalars or plain_scalars(file.space)).eps_deg)
    base = getattr(own, "base", None) if base is None else as_policy(base)
    base = None if base is None else policy_of(base, file.space)
    return agreement_of(policy_of(own, file.space), file.labels, file.space, eps, base)


def _labels(
    labels: Any, space: Any, cues: Any = "", low: Any = None, high: Any = None, before: LogsConfig | None = None
) -> LabelFile:
    """Return checked labels with their space; `before`: the recording by which the policy was corrected before.

    Raises UserError for labels that do not fit their space.
    """
    options = {"space": space, "cues": cues or None, "low": low, "high": high}
    names = [name for name, value in options.items() if value is not None]
    if isinstance(labels, str | os.PathLike):
        if names:
            raise UserError(f"{labels} says its own space of actions: leave out {names[0]}")
        return labels_from_file(Path(labels))
    rows, note = rows_of(labels), partial(warnings.warn, stacklevel=5)
    if space is not None and len(names) > 1:
        raise UserError(f"{names[1]} is given beside space, which says it already: leave out one of them")
    if before is not None and not names:
        space = logs.space_of(before)
    if space is None:
        low, high = (
            None if end is None else np.atleast_1d(numbers("low and high", end)).tolist() for end in (low, high)
        )
        low, high = logs.bounds_of(np.asarray(rows.action), low, high, note=note)
        space = Box(tuple(low), tuple(high), cues_from(cues) if cues else ())
    external_labels.check(rows, Spaces(rows.obs.shape[1], space), RELATIVE)
    return LabelFile({}, RELATIVE.name, space, None, np.zeros(len(rows.obs)), rows)


def world_of(file: LabelFile, before: LogsConfig | None = None) -> World:
    """Return the situations of labels as a world of the task `logs`, which names no folder.

    Networks of a policy that was corrected `before` keep their view. Raises UserError where that cannot be.
    """
    size, obs, space = file.labels.obs.shape[1], np.asarray(file.labels.obs), file.space
    if before is not None and logs.space_of(before) != space:
        advice = "leave out cues, low, high and space"
        raise UserError(f"the policy was corrected with other bounds or cues before: {advice}")
    recording = before or (from_json(LogsConfig, file.task) if file.task.get("name") == logs.NAME else None)
    if recording is not None and sum(recording.entries) == size:
        config = dataclasses.replace(recording, path="", digest="", order="recorded", rows=len(obs))
    else:
        (centre, spread), kind = logs.scales_of(obs), cast(logs.Actions, space.name)
        cues = () if space == DIRECTIONS else space.cues
        config = LogsConfig(
            rows=len(obs),
            entries=(size,),
            centre=centre,
            spread=spread,
            actions=kind,
            low=getattr(space, "low", (0.0,) * space.size),
            high=getattr(space, "high", (1.0,) * space.size),
            cues=tuple(",".join(cue.words) for cue in cues),
            cue_names=tuple(cue.name for cue in cues),
            keys=tuple(",".join(cue.keys) for cue in cues),
        )
    if logs.space_of(config).to_json() != space.to_json():
        raise UserError(f"the space {space.name!r} is not one that a recording can have: give a box with plain cues")
    filled = lambda config, split: logs.filled(config, obs, file.labels.action)  # noqa: E731
    return World(logs.configured(config, dataclasses.replace(logs.BODY, environment=filled)), config)
