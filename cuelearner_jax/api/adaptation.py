"""Adaptation from Python: what `cuelearner adapt` does, with a policy to call as its result."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cuelearner_jax import user_code
from cuelearner_jax.adaptation import adapting, judging, program
from cuelearner_jax.adaptation.adapting import Adaptation, Adapted, Judging
from cuelearner_jax.api import arguments
from cuelearner_jax.api.acting import CallablePolicy, as_policy, as_policy_in
from cuelearner_jax.api.feedback import Labels, diverged, given_settings, label_path, labels_of, rows_of, settings
from cuelearner_jax.api.worlds import World
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import Environment, spaces_of
from cuelearner_jax.errors import UserError, closest
from cuelearner_jax.feedback import given
from cuelearner_jax.feedback.answers import check_teacher
from cuelearner_jax.guides import registry
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.policies import Common, Opaque
from cuelearner_jax.runs import adapted as folders
from cuelearner_jax.runs.adaptation import DEFAULT_KIND, MOST_ENVS, told
from cuelearner_jax.runs.adapted import alone
from cuelearner_jax.runs.order import check_world
from cuelearner_jax.storage import label_files, policy_folders
from cuelearner_jax.types import Label, Teacher


@dataclasses.dataclass(frozen=True, kw_only=True)
class AdaptedPolicy(CallablePolicy):
    """A policy under a feedback model, within a bound; or the policy as it was, where the model is not `used`."""

    found: Adapted
    world: World | None  # in which it was adapted, if that is known
    named: str  # the base, as Python calls it

    @property
    def used(self) -> bool:
        """Is the model used? Not if it made the policy worse."""
        return bool(self.found.judged.used[0])

    @property
    def judged(self) -> tuple[str, float, float]:
        """(metric, before, after): what the policy was worth on the tuning episodes, and what the model makes of it."""
        of = self.found.judged
        return of.by, float(of.before[0]), float(of.after[0])

    @property
    def difference(self) -> tuple[float, float, float]:
        """After less before, and the ends of its 95% interval over the tuning episodes; nan where labels judge."""
        estimate, lower, upper = (float(value) for value in self.found.judged.difference[0])
        return estimate, lower, upper

    @property
    def rewarded_steps(self) -> int:
        """Environment steps whose rewards or outcomes decided whether the model is used; 0 where labels judge."""
        return int(self.found.judged.rewarded_steps[0])

    @property
    def labels(self) -> Labels:
        """What was answered (of relative feedback)."""
        return labels_of(jax.tree.map(lambda leaf: leaf[0], self.found.block.guide.labels))

    @user_code.told
    def save(self, folder: str | Path, overwrite: bool = False) -> None:
        """Writes a policy folder, as `cuelearner adapt` does; `load_policy` and every command take it.

        Raises UserError if the folder is in use, or the policy was adapted in no world that can be named.
        """
        folder = arguments.path("folder", folder)
        arguments.flag("overwrite", overwrite)
        if folder.exists() and not folder.is_dir():
            raise UserError(f"folder {folder} is a file: give another")
        if self.world is None:
            raise UserError(
                "a policy folder says in which world its policy acts: adapt in a world, as cl.make gives it"
            )
        origin = {"code": self.named}
        with policy_folders.place_of(folder, overwrite) as place:
            folders.write(place, self.found, self.world.task, self.world.config, origin)


@user_code.told
def adapt(
    policy: Any,
    world: World | Environment,
    teacher: Teacher | None = None,
    *,
    labels: int | Labels | str | os.PathLike[str] = 300,
    bound_deg: float | None = None,
    eps_deg: float | None = None,
    guidance: str = DEFAULT_KIND,
    sizes: GuideSizes | None = None,
    scalars: Scalars | None = None,
    seed: int = 0,
    judge_by: str = "reward",
    judge_episodes: int = 100,
    judge_bounds: Sequence[float] = (),
) -> AdaptedPolicy:
    """Corrects a finished policy by labels about what it does in a (changed) world.

    Labels are asked for in rounds, about actions refined by the model so far (DAgger), within a bound of the policy's
    own. A model that makes the policy worse than it was, on tuning episodes of the world, is not used, with a warning.

    Args:
        policy: what is to be corrected: a policy, or any function of a batch of observations (NumPy in, NumPy out; one
            that `jax.jit` made is compiled in).
        world: where it acts; a bare environment will do.
        teacher: who answers; None where labels are given.
        labels: number of questions; or labels that are there already: arrays, or a label file.
        bound_deg: how far corrections may lead from the policy's own actions [deg] (default: 45; of labels that are
            there already as far as they reach).
        eps_deg: strength of an answer [deg] (default: the scalars', of a file the file's).
        guidance: kind of guidance: what is asked, and what a model makes of it.
        sizes: of the network, its fitting, and the labels of a round.
        scalars: of the fitting, of refinement and of the teacher's faults.
        seed: of everything random.
        judge_by: the metric by which it is judged, or "labels": by the prediction of held-out ones.
        judge_episodes: that many tuning episodes, each of 100 steps where the task does not count episodes.
        judge_bounds: shares of the bound, such as (0.5, 0.25), within which the model is tried on these episodes too;
            it is used within what is worth most.

    Raises:
        UserError: settings that make no sense, or with which the fit diverges.
    """
    base, place, seed = Common(as_policy(policy)), _Place.of(world), arguments.seed("seed", seed)
    sizes, scalars, eps_deg = given_settings(sizes, scalars, eps_deg)
    bound_deg = None if bound_deg is None else arguments.angle("bound_deg", bound_deg)
    how = place.judging(judge_by, judge_episodes, judge_bounds)
    kind = registry.resolve(arguments.text("guidance", guidance))
    if not kind.asks:
        raise UserError(f"guidance {guidance!r} asks nothing that could be learned from: choose another")
    as_policy_in(policy, place.env)
    if teacher is not None:
        arguments.answers_in("teacher", arguments.teacher("teacher", teacher), place.env)
    file = label_files.read(label_path(labels)) if isinstance(labels, str | os.PathLike) else None
    if file is not None:
        eps_deg = file.eps_deg if eps_deg is None else eps_deg
        sizes, scalars = adapting.falling(sizes or adapting.SIZES, scalars or Scalars(), file.labels.eps_deg)
    sizes, scalars = settings(sizes, scalars, eps_deg)
    bundle = registry.make(kind.name, sizes, place.env)
    rows = None
    if file is None and not isinstance(labels, tuple):
        budget = arguments.budget("labels", labels)
        if teacher is None:
            raise UserError("labels are asked of a teacher: give one, for instance teacher_of(world), or labels")
        check_teacher(teacher, scalars)
    else:
        if file is not None and place.world is not None:
            check_world(Path(str(labels)), file.task, place.world.task, place.world.config)
        rows = _of_file(file, bundle) if file is not None else _of_arrays(labels)
        assert bundle.form is not None  # it asks
        given.check(rows, spaces_of(place.env), bundle.form)
        budget = len(rows.obs)
        if bound_deg is None:
            bound_deg = max(adapting.reach(base.policy, rows.obs, rows.action), scalars.eps_deg)
    bound_deg = adapting.BOUND_DEG if bound_deg is None else bound_deg
    if note := adapting.check_angles([bound_deg], scalars):
        warnings.warn(note, stacklevel=2)
    lanes = program.product(1, (seed,), (budget,), (bound_deg,))
    slots = program.rounds(lanes, sizes) * sizes.labels_per_round
    padded = None if rows is None else jax.tree.map(lambda leaf: _padded(leaf, slots)[None], rows)
    asked = Adaptation(bundle, sizes, scalars, place.env, base, lanes, how)
    found = adapting.adapt(asked, teacher, padded)
    if found.block.failed.any():
        program.blame(base, teacher, found.block)
        raise diverged()
    if not found.judged.used.all():
        warnings.warn(told(found)[0], stacklevel=2)
    own = alone(found.policy(place.env), 0)
    observation = getattr(place.env, "observation", ())
    return AdaptedPolicy(own, observation, found=found, world=place.world, named=_called(policy))


class _Place(NamedTuple):
    """Where a policy is adapted."""

    env: Environment  # in which is asked
    tuned: Environment  # with the tuning episodes
    steps: int  # of an episode
    world: World | None

    @classmethod
    def of(cls, world: World | Environment) -> _Place:
        if not isinstance(world, World):
            if isinstance(world, type) or not all(callable(getattr(world, name, None)) for name in ("reset", "step")):
                raise arguments.refused("world", world, "a world, as cl.make gives it, or an environment")
            return cls(world, world, judging.STEPS, None)
        longest = world.task.longest
        steps = longest(world.config) if longest else judging.STEPS
        return cls(world.env, world.environment("tuning"), steps, world)

    def judging(self, by: Any, episodes: Any, bounds: Any) -> Judging:
        """How policies are judged there. Raises UserError for what makes no sense."""
        episodes, shares = arguments.whole("judge_episodes", episodes, 1, MOST_ENVS), "shares of the bound below 1"
        given = arguments.several("judge_bounds", bounds, shares)
        bounds = tuple(arguments.number("judge_bounds", bound, 1.0, shares) for bound in given)
        arguments.text("judge_by", by)
        known = [*judging.metrics_of(self.env), judging.LABELS]
        if by not in known:
            raise UserError(f"judge_by is {by!r}, no metric of this world{closest(by, known)}")
        judging.check_bounds(bounds, by, "judge_bounds")
        return Judging(None if by == judging.LABELS else self.tuned, episodes, episodes * self.steps, by, bounds=bounds)


def _of_file(file: label_files.LabelFile, bundle: Guidance) -> Label:
    """A file's labels, of its first seed. Raises UserError if they are not what the guidance asks for."""
    assert bundle.form is not None  # it asks
    if file.answers != bundle.form.name:
        raise UserError(f"the file holds {file.answers} answers: {bundle.name} guidance needs {bundle.form.name} ones")
    given.check_file(file, None, bundle.form, "the file")
    own = file.seeds == file.seeds[0]
    return jax.tree.map(lambda leaf: np.asarray(leaf)[own], file.labels)


def _of_arrays(labels: Any) -> Label:
    """Arrays as rows. Raises UserError if they are not three of one length."""
    obs, action, answer = rows_of(labels)
    answer = answer[:, None] if answer.ndim == 1 else answer
    return Label(obs, action, answer, np.ones(len(obs), bool))  # pyright: ignore[reportArgumentType]


def _padded(rows: np.ndarray, slots: int) -> np.ndarray:
    return np.concatenate([rows, np.zeros((slots - len(rows), *rows.shape[1:]), rows.dtype)])


def _called(policy: Any) -> str:
    """How Python calls a policy."""
    inner = as_policy(policy)
    inner = inner.function if isinstance(inner, Opaque) else inner
    name = getattr(inner, "__qualname__", type(inner).__qualname__)
    return f"{getattr(inner, '__module__', type(inner).__module__)}:{name}"
