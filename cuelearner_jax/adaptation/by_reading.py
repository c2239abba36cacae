"""Adaptation by a reading of relative answers, one lane after another, outside compiled programs.

of = ReadingAdaptation(guide, sizes, scalars, env, bases, family)
found = adapt(of, lanes, Judging(None, by="labels"), teacher)
found.results[0].words(), found.policy(env)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from cuelearner_jax.adaptation.by_model import SIZES, AdaptationResult
from cuelearner_jax.adaptation.judging import LABELS, Judge, Judgement, Judging
from cuelearner_jax.adaptation.lanes import Adaptation, Lanes
from cuelearner_jax.config import GuideSizes, Scalars, TeacherFaults
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import Tell, ignore_progress
from cuelearner_jax.reading import Read, Reading, Result, Walk
from cuelearner_jax.reading.correction import Correction
from cuelearner_jax.reading.families import Family
from cuelearner_jax.reading.fitting import pick
from cuelearner_jax.reading.policy import unread
from cuelearner_jax.reading.session import BATCHES, LEAST_BATCH
from cuelearner_jax.types import Label, Teacher

USUAL = 100  # default number of labels
LEAST = 2 * LEAST_BATCH  # labels: those of the first batch say nothing for or against a correction
CHOICE = 6  # situations met for each question
# fields of the scalars that a reading uses
USED = ("eps_deg", *(entry.name for entry in dataclasses.fields(TeacherFaults)))


class ReadingAdaptation(Adaptation):
    """The world, base policies and family that all lanes of a reading share."""

    family: Family = struct.field(pytree_node=False)  # possible changes; empty: shifts of entries of the observation
    named: str = struct.field(pytree_node=False, default="")  # the code of it; empty: the world declares it

    def policy(self, block: Any, env: Any = None) -> Read:
        """Return every lane's corrected policy."""
        base, space = self.bases.lane(block.base), actions_of(self.env)
        return Read(base, block.correction, block.bound, space, self.family, self.named)

    def unread(self, base: Any, like: Correction | None = None) -> Read:
        """Return a policy that corrects nothing; `like`: a correction with the sizes of its arrays."""
        labels, mixed = (0, 0) if like is None else (like.known.shape[-2], like.frame.mixed.shape[-1])
        return unread(base, actions_of(self.env), self.family, self.env.obs_size, labels, mixed)


class Evidence(struct.PyTreeNode):
    """A block of lanes with their answers and corrections."""

    base: Int[Array, " lanes"]
    correction: Correction  # (lanes, ...)
    labels: Label  # (lanes, slots, ...)
    asked: Int[Array, " lanes"]
    bound: Float[Array, " lanes"]
    corrects: Bool[Array, " lanes"]  # True where the answers show a change
    failed: Bool[Array, " lanes"]


def settling(scalars: Scalars, eps_deg: float | None) -> Scalars:
    """Return the scalars of a teacher whose answers have strength `eps_deg` (None: the given scalars' strength)."""
    kept = {name: getattr(scalars, name) for name in USED} | ({} if eps_deg is None else {"eps_deg": eps_deg})
    return dataclasses.replace(Scalars(), **kept)


def check_unused(sizes: GuideSizes, scalars: Scalars, **others: Any) -> None:
    """Raise UserError for a setting of feedback models or of refinement, which a reading does not use."""
    plain = dataclasses.replace(SIZES, labels_per_round=sizes.labels_per_round)
    groups = [("sizes", sizes, plain), ("scalars", scalars, settling(scalars, None))]
    wrong = [
        f"{name}.{entry.name}"
        for name, group, used in groups
        for entry in dataclasses.fields(used)
        if getattr(group, entry.name) != getattr(used, entry.name)
    ]
    for name in [*wrong, *(name for name, value in others.items() if value not in ((), None))]:
        raise UserError(f"{name} is given, but guidance reading fits no network: leave {name} out")


def adapt(
    of: ReadingAdaptation,
    lanes: Lanes,
    how: Judging,
    teacher: Teacher | None = None,
    labels: Label | None = None,
    watch: Callable[[str], Tell] = lambda what: ignore_progress,
) -> AdaptationResult:
    """Ask for answers, read what changed and judge the corrected policy in every lane.

    Arguments as for `by_model.adapt`. `how.by` "labels": the answers decide, each batch predicted before it is read.
    """
    tell, total, space = watch("labels"), int(lanes.budget.sum()), actions_of(of.env)
    rows, results, steps, asked = [], [], [], 0  # `steps`: the corrections before each batch of questions
    for base, seed, budget, _ in zip(*(column.tolist() for column in lanes), strict=True):
        observation = getattr(of.env, "observation", ())
        reading = Reading(of.bases.lane(base), of.family, space, float(of.scalars.eps_deg), budget, observation)
        if labels is None:
            progress = lambda count, before=asked: tell(before + count, total)  # noqa: E731
            own, policies = _asked(of, reading, seed, budget, teacher, progress)
        else:
            own, policies = jax.tree.map(lambda leaf: np.asarray(leaf)[len(rows)], labels), []
            reading.read_in_batches(*(part[own.valid] for part in (own.obs, own.action, own.answer)))
        rows.append(own)
        steps.append([policy.correction for policy in policies])
        results.append(reading.result())
        asked += budget
        tell(asked, total)
    block = Evidence(
        base=jnp.asarray(lanes.base),
        correction=_stacked([one.policy.correction for one in results]),
        labels=_padded(rows) if labels is None else labels,
        asked=jnp.asarray(lanes.budget),
        bound=jnp.asarray(space.from_unit(lanes.bound_deg)),
        corrects=jnp.asarray(np.array([one.changed for one in results])),
        failed=jnp.zeros(lanes.number, bool),
    )
    judge = Judge(of, lanes, how, lane_mesh(jax.local_devices()[:1]), watch)
    if how.every and how.env is not None:
        for step in range(max(map(len, steps))):
            then = _stacked([lane[min(step, len(lane) - 1)] for lane in steps])
            count = np.minimum(step * _batch(lanes.budget), lanes.budget)
            judge.measure(block.replace(correction=then, asked=jnp.asarray(count)))
    if how.by != LABELS:
        judged, block = judge.judge_lanes(block)
    else:
        if how.env is not None:
            judge.measure(block)
        nothing, unknown = np.zeros(lanes.number), np.full((lanes.number, 3), np.nan)
        evidence, used = (np.array([getattr(one, name) for one in results]) for name in ("evidence", "used"))
        judged = Judgement(LABELS, nothing, evidence, used, lanes.bound_deg, unknown, nothing.astype(int))
    nothing = of.unread(None, block.correction).correction
    keep = jax.vmap(lambda used, own: jax.tree.map(partial(jnp.where, used), own, nothing))
    block = block.replace(correction=keep(jnp.asarray(judged.used), block.correction))
    return AdaptationResult(of, lanes, block, judged, judge.curve, tuple(results))


def _batch(budget: Any) -> Any:
    return np.maximum(LEAST_BATCH, -(-budget // BATCHES))


def _asked(
    of: ReadingAdaptation, reading: Reading, seed: int, budget: int, teacher: Any, tell: Callable[[int], None]
) -> tuple[Label, list[Read]]:
    """Return one lane's labels, and its policies before each batch of questions."""
    walk, rows, policies = Walk(of.env, teacher, of.scalars), [], []
    key, size = jax.random.key(seed), int(_batch(budget))
    for asked in range(0, budget, size):
        tell(asked)
        key, k_where, k_ask, k_answer = jax.random.split(key, 4)
        count, policy = min(size, budget - asked), reading.policy()
        policies.append(policy)
        states, obs = walk.situations(k_where, policy, CHOICE * size)
        index, action = reading.questions(np.asarray(obs), count, k_ask)
        states, obs = pick((states, obs), index)
        answer = np.asarray(walk.answers(k_answer, states, obs, jnp.asarray(action)))
        rows.append((np.asarray(obs), action, answer))
        there = np.isfinite(answer).any(-1)
        reading.learn(np.asarray(obs)[there], action[there], answer[there])
    obs, action, answer = (np.concatenate(column) for column in zip(*rows, strict=True))
    valid = np.asarray(np.isfinite(answer).any(-1))
    return Label(obs, action, np.where(valid[:, None], answer, 0), valid), policies  # pyright: ignore[reportArgumentType]


def _stacked(corrections: list[Correction]) -> Correction:
    """Return corrections side by side; those of fewer labels get situations without weight."""
    most = max(len(one.known) for one in corrections)

    def filled(rows: Array) -> Array:
        return jnp.concatenate([rows, jnp.zeros((most - len(rows), rows.shape[1]))])

    each = [one.replace(known=filled(one.known), alpha=filled(one.alpha)) for one in corrections]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def _padded(sets: list[Label]) -> Label:
    """Return the labels of all lanes, padded to the same number of rows."""
    most = max(len(rows.obs) for rows in sets)

    def padded(leaf: Any) -> np.ndarray:
        return np.pad(np.asarray(leaf), [(0, most - len(leaf)), *[(0, 0)] * (np.ndim(leaf) - 1)])

    return jax.tree.map(lambda *leaves: np.stack([padded(leaf) for leaf in leaves]), *sets)


def to_json(results: tuple[Result, ...]) -> list[dict[str, Any]]:
    """Return the results as JSON values, without their policies."""
    kept = ("used", "changed", "evidence", "depends", "near", "wrong")
    return [
        {name: getattr(one, name) for name in kept} | {"estimates": [estimate._asdict() for estimate in one.estimates]}
        for one in results
    ]
