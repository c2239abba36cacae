"""Adaptation by calibration: estimate what changed in the world, one lane after another, outside compiled programs.

of = Calibrating(guide, sizes, scalars, env, bases, family)
found = adapt(of, lanes, Judging(None, by="labels"), teacher)
found.results[0].estimates, found.policy(env)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from cuelearner_jax.adaptation.by_model import SIZES, AdaptationResult
from cuelearner_jax.adaptation.judging import LABELS, Judge, Judgement, Judging
from cuelearner_jax.adaptation.lanes import Adaptation, Lanes
from cuelearner_jax.calibration import CHANGED, Calibrated, Distortion, Result, Walk, calibrate, read_answers
from cuelearner_jax.calibration.families import Family, unknowns_of
from cuelearner_jax.config import GuideSizes, Scalars, TeacherFaults
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import Tell, ignore_progress
from cuelearner_jax.types import Label, Teacher

USUAL = 100  # default number of labels
LEAST = 5  # labels: every fifth is held out
# fields of the scalars that calibration reads
USED = ("eps_deg", *(entry.name for entry in dataclasses.fields(TeacherFaults)))
Theta = dict[str, float]  # unknowns by name; one that is not there is zero


class Calibrating(Adaptation):
    """The guide, world, base policies and family that all lanes of a calibration share."""

    family: Family = struct.field(pytree_node=False)  # possible changes
    named: str = struct.field(pytree_node=False, default="")  # the code of it; empty: the world declares it

    def policy(self, block: Any, env: Any = None) -> Calibrated:
        """Return every lane's policy: its base's actions, corrected for the estimated changes."""
        return Calibrated(self.bases.lane(block.base), block.theta, self.family, self.named)


class Evidence(struct.PyTreeNode):
    """A block of lanes with their answers and estimates."""

    base: Int[Array, " lanes"]
    theta: Float[Array, "lanes unknowns"]  # corrected values of the unknowns
    labels: Label  # (lanes, slots, ...)
    asked: Int[Array, " lanes"]
    bound: Float[Array, " lanes"]
    corrects: Bool[Array, " lanes"]  # True where the answers show a change
    failed: Bool[Array, " lanes"]


class _Lane(NamedTuple):
    """One lane's answers and its `Calibration`."""

    result: Result
    rows: Label  # (labels, ...)
    thetas: list[Theta]  # on the way, before each measurement


def settling(scalars: Scalars, eps_deg: float | None) -> Scalars:
    """Return the scalars of a teacher whose answers have strength `eps_deg` (None: the given scalars' strength)."""
    kept = {name: getattr(scalars, name) for name in USED}
    return dataclasses.replace(Scalars(), **{**kept, **({} if eps_deg is None else {"eps_deg": eps_deg})})


def check_unused(sizes: GuideSizes, scalars: Scalars, **others: Any) -> None:
    """Raise UserError for a setting of feedback models or of refinement, which calibration does not use."""
    groups = {"sizes": (SIZES, ("labels_per_round",)), "scalars": (Scalars(), USED)}
    for name, group in {"sizes": sizes, "scalars": scalars}.items():
        plain, used = groups[name]
        for entry in dataclasses.fields(plain):
            if entry.name not in used:
                value = getattr(group, entry.name)
                others[f"{name}.{entry.name}"] = () if value == getattr(plain, entry.name) else value
    for name, value in others.items():
        if value not in ((), None):
            given = " ".join(map(str, value)) if isinstance(value, tuple) else value
            raise UserError(f"{name} is {given}, but calibration fits no model and has no bound: leave {name} out")
    if scalars.answer == "shuffled":
        raise UserError(
            "scalars.answer is shuffled, which is a control of feedback models: give --scalars.answer best or nearest"
        )


def adapt(
    of: Calibrating,
    lanes: Lanes,
    how: Judging,
    teacher: Teacher | None = None,
    labels: Label | None = None,
    watch: Callable[[str], Tell] = lambda what: ignore_progress,
) -> AdaptationResult:
    """Ask for answers, estimate the changes and judge the corrected policy in every lane.

    Args:
        of: settings that all lanes share.
        lanes: the lanes to adapt.
        how: settings of the judgement; "labels" means calibration's own rule on held-out answers.
        teacher: the teacher who answers; None where labels are given.
        labels: rows (lanes, slots, ...) in place of questions.
        watch: takes the name of a piece of work, returns its progress callback.

    Raises:
        UserError: too few answers, or policies cannot be judged as asked.
    """
    tell, total = watch("labels"), int(lanes.budget.sum())
    found = []
    for lane in range(lanes.number):
        base, seed, budget = of.bases.lane(int(lanes.base[lane])), int(lanes.seed[lane]), int(lanes.budget[lane])
        if labels is not None:
            found.append(_given(of, base, seed, jax.tree.map(lambda leaf, lane=lane: leaf[lane], labels)))
        else:
            assert teacher is not None  # asked for where no labels are given
            before = int(lanes.budget[:lane].sum())
            told = lambda asked, before=before: tell(before + asked, total)  # noqa: E731
            found.append(_asked(of, base, seed, budget, teacher, how.every, told))
    return _judged(of, lanes, how, found, labels, watch)


def _asked(
    of: Calibrating, base: Any, seed: int, budget: int, teacher: Teacher, every: int, tell: Callable[[int], None]
) -> _Lane:
    walk, rows, thetas = Walk(of.env, teacher, of.scalars), [], []
    first: list[Any] = []  # the policy before any answer

    def situations(key: Any, policy: Any, count: int) -> tuple[Any, Any]:
        first.append(policy)
        asked = sum(len(row[0]) for row in rows)
        tell(asked)
        if every and asked % every == 0:
            thetas.append({} if policy is first[0] else _theta(policy))
        return walk.situations(key, policy, count)

    def answers(key: Any, states: Any, obs: Any, actions: Any) -> Any:
        told = walk.answers(key, states, obs, actions)
        rows.append((np.asarray(obs), np.asarray(actions), np.asarray(told)))
        return told

    eps = float(of.scalars.eps_deg)
    how = {"space": actions_of(of.env), "eps_deg": eps}
    result = calibrate(base, of.family, situations, answers, budget, jax.random.key(seed), **how)
    tell(budget)
    obs, action, answer = (np.concatenate(column) for column in zip(*rows, strict=True))
    valid = np.asarray(np.isfinite(answer).any(-1))
    return _Lane(result, Label(obs, action, np.where(valid[:, None], answer, 0), valid), thetas)  # pyright: ignore[reportArgumentType]


def _given(of: Calibrating, base: Any, seed: int, rows: Label) -> _Lane:
    valid = np.asarray(rows.valid)
    answers = (np.asarray(part)[valid] for part in (rows.obs, rows.action, rows.answer))
    how = {"space": actions_of(of.env), "eps_deg": float(of.scalars.eps_deg), "seed": seed}
    return _Lane(read_answers(base, of.family, *answers, **how), rows, [])


def _theta(policy: Calibrated) -> Theta:
    names = [one.name for one in unknowns_of(policy.family)]
    return dict(zip(names, np.asarray(policy.theta).tolist(), strict=True))


def _judged(
    of: Calibrating, lanes: Lanes, how: Judging, found: list[_Lane], labels: Label | None, watch: Any
) -> AdaptationResult:
    results = tuple(lane.result for lane in found)
    thetas = [_theta(one.policy) if one.changes else {} for one in results]
    of = of.replace(family=_used(of.family, [*thetas, *(theta for lane in found for theta in lane.thetas)]))
    corrects = np.array([one.verdict == CHANGED for one in results])
    block = Evidence(
        base=jnp.asarray(lanes.base),
        theta=_stacked(of.family, thetas),
        labels=_padded([lane.rows for lane in found]) if labels is None else labels,
        asked=jnp.asarray(lanes.budget),
        bound=jnp.asarray(actions_of(of.env).from_unit(lanes.bound_deg)),
        corrects=jnp.asarray(corrects),
        failed=jnp.zeros(lanes.number, bool),
    )
    judge = Judge(of, lanes, how, lane_mesh(jax.local_devices()[:1]), watch)
    for step in range(max(len(lane.thetas) for lane in found)):
        then = [lane.thetas[step] if step < len(lane.thetas) else own for lane, own in zip(found, thetas, strict=True)]
        asked = np.minimum(step * how.every, lanes.budget)
        judge.measure(block.replace(theta=_stacked(of.family, then), asked=jnp.asarray(asked)))
    if how.by == LABELS:
        if how.env is not None:
            judge.measure(block)
        before, after = (np.array([one.held_out[end] for one in results]) for end in (0, 1))
        unknown, none = np.full((lanes.number, 3), np.nan), np.zeros(lanes.number, int)
        judged = Judgement(LABELS, before, after, corrects, lanes.bound_deg, unknown, none)
    else:
        judged, _ = judge.judge_lanes(block)
    theta = jnp.where(jnp.asarray(judged.used)[:, None], block.theta, 0.0)
    return AdaptationResult(of, lanes, block.replace(theta=theta), judged, judge.curve, results)


def _used(family: Family, thetas: list[Theta]) -> Family:
    """Return the distortions that any lane has an unknown of.

    Distortions that ask the policy again come first, as in `Fit`.
    """
    names = {name for theta in thetas for name in theta}

    def corrects(one: Distortion) -> bool:
        return not one.of_teacher and any(unknown.name in names for unknown in one.unknowns)

    return tuple(sorted(filter(corrects, family), key=lambda one: not one.asks))


def _stacked(family: Family, thetas: list[Theta]) -> Float[Array, "lanes unknowns"]:
    names = [one.name for one in unknowns_of(family)]
    rows = [[theta.get(name, 0.0) for name in names] for theta in thetas]
    return jnp.asarray(np.array(rows, np.float32).reshape(len(thetas), len(names)))


def _padded(sets: list[Label]) -> Label:
    """Return the labels of all lanes, padded to the same number of rows."""
    most = max(len(rows.obs) for rows in sets)

    def padded(leaf: Any) -> np.ndarray:
        leaf = np.asarray(leaf)
        return np.concatenate([leaf, np.zeros((most - len(leaf), *leaf.shape[1:]), leaf.dtype)])

    return jax.tree.map(lambda *leaves: np.stack([padded(leaf) for leaf in leaves]), *sets)


def sentences(found: AdaptationResult) -> list[str]:
    """Describe each lane's result: one line for each estimate, then the judgement."""
    lanes, judged, lines = found.lanes, found.judged, []
    for lane, result in enumerate(found.results):
        several = f", seed {lanes.seed[lane]}" if lanes.number > 1 else ""
        told = result.words()
        if result.verdict == CHANGED:
            ends = f"{judged.before[lane]:.4g} before, {judged.after[lane]:.4g} after"
            if judged.by == LABELS:
                told.append(f"mean log probability of held-out answers {ends}; no rewarded step was taken")
            else:
                ends += f" ({judged.rewarded_steps[lane]:,} rewarded steps)"
                left = "" if judged.used[lane] else "; worse, so the policy stays as it was"
                told.append(f"{judged.by} on tuning episodes {ends}{left}")
        lines += [f"{lanes.budget[lane]} labels{several}: {line}" for line in told]
    return lines


def to_json(results: tuple[Result, ...]) -> list[dict[str, Any]]:
    """Return the results as JSON values, without their policies."""
    kept = ("verdict", "changes", "held_out", "confirmed", "refused", "wrong", "apart", "more")
    return [
        {name: getattr(one, name) for name in kept} | {"estimates": [estimate._asdict() for estimate in one.estimates]}
        for one in results
    ]
