"""Adaptation by a reading of relative answers, one lane after another, outside compiled programs.

of = ReadingAdaptation(guide, sizes, scalars, env, bases, family)
found = adapt(of, lanes, Judging(None, by="labels"), teacher)
found.results[0].words(), found.policy(env)
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
from cuelearner_jax.config import GuideSizes, Scalars, TeacherFaults
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import Tell, ignore_progress
from cuelearner_jax.reading import Read, Reading, Result, Walk
from cuelearner_jax.reading.correction import Correction
from cuelearner_jax.reading.families import Family
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


class Evidence(struct.PyTreeNode):
    """A block of lanes with their answers and corrections."""

    base: Int[Array, " lanes"]
    correction: Correction  # (lanes, ...)
    labels: Label  # (lanes, slots, ...)
    asked: Int[Array, " lanes"]
    bound: Float[Array, " lanes"]
    corrects: Bool[Array, " lanes"]  # True where the answers show a change
    failed: Bool[Array, " lanes"]


class _Lane(NamedTuple):
    """One lane's answers and what they say."""

    result: Result
    rows: Label  # (labels, ...)
    policies: list[Read]  # on the way, before each batch


def settling(scalars: Scalars, eps_deg: float | None) -> Scalars:
    """Return the scalars of a teacher whose answers have strength `eps_deg` (None: the given scalars' strength)."""
    kept = {name: getattr(scalars, name) for name in USED}
    return dataclasses.replace(Scalars(), **{**kept, **({} if eps_deg is None else {"eps_deg": eps_deg})})


def check_unused(sizes: GuideSizes, scalars: Scalars, **others: Any) -> None:
    """Raise UserError for a setting of feedback models or of refinement, which a reading does not use."""
    groups = {"sizes": (SIZES, ("labels_per_round",)), "scalars": (Scalars(), USED)}
    for name, group in {"sizes": sizes, "scalars": scalars}.items():
        plain, used = groups[name]
        for entry in dataclasses.fields(plain):
            if entry.name not in used:
                value = getattr(group, entry.name)
                others[f"{name}.{entry.name}"] = () if value == getattr(plain, entry.name) else value
    for name, value in others.items():
        if value not in ((), None):
            written = " ".join(map(str, value)) if isinstance(value, tuple) else value
            raise UserError(f"{name} is {written}, but guidance reading fits no network: leave {name} out")


def adapt(
    of: ReadingAdaptation,
    lanes: Lanes,
    how: Judging,
    teacher: Teacher | None = None,
    labels: Label | None = None,
    watch: Callable[[str], Tell] = lambda what: ignore_progress,
) -> AdaptationResult:
    """Ask for answers, read what changed and judge the corrected policy in every lane.

    Args:
        of: settings that all lanes share.
        lanes: the lanes to adapt.
        how: settings of the judgement; "labels": the answers decide, each batch predicted before it is read.
        teacher: the teacher who answers; None where labels are given.
        labels: rows (lanes, slots, ...) in place of questions.
        watch: takes the name of a piece of work, returns its progress callback.

    Raises:
        UserError: too few answers, or policies cannot be judged as asked.
    """
    tell, total = watch("labels"), int(lanes.budget.sum())
    found = []
    for lane in range(lanes.number):
        before = int(lanes.budget[:lane].sum())
        progress = lambda asked, before=before: tell(before + asked, total)  # noqa: E731
        base, budget = of.bases.lane(int(lanes.base[lane])), int(lanes.budget[lane])
        reading = Reading(
            base, of.family, actions_of(of.env), float(of.scalars.eps_deg), budget, getattr(of.env, "observation", ())
        )
        if labels is not None:
            found.append(_given(of, reading, jax.tree.map(lambda leaf, lane=lane: leaf[lane], labels)))
        else:
            assert teacher is not None  # asked for where no labels are given
            found.append(_asked(of, reading, int(lanes.seed[lane]), budget, teacher, progress))
        progress(budget)
    return _judged(of, lanes, how, found, labels, watch)


def _asked(
    of: ReadingAdaptation,
    reading: Reading,
    seed: int,
    budget: int,
    teacher: Teacher,
    tell: Callable[[int], None],
) -> _Lane:
    walk, rows, policies = Walk(of.env, teacher, of.scalars), [], []
    key, size = jax.random.key(seed), max(LEAST_BATCH, -(-budget // BATCHES))
    for asked in range(0, budget, size):
        tell(asked)
        key, k_where, k_ask, k_answer = jax.random.split(key, 4)
        count, policy = min(size, budget - asked), reading.policy()
        policies.append(policy)
        states, obs = walk.situations(k_where, policy, CHOICE * size)
        index, action = reading.questions(np.asarray(obs), count, k_ask)
        states, obs = jax.tree.map(lambda leaf, index=index: leaf[index], (states, obs))
        answer = np.asarray(walk.answers(k_answer, states, obs, jnp.asarray(action)))
        rows.append((np.asarray(obs), action, answer))
        there = np.isfinite(answer).any(-1)
        reading.learn(np.asarray(obs)[there], action[there], answer[there])
    obs, action, answer = (np.concatenate(column) for column in zip(*rows, strict=True))
    valid = np.asarray(np.isfinite(answer).any(-1))
    return _Lane(reading.result(), Label(obs, action, np.where(valid[:, None], answer, 0), valid), policies)  # pyright: ignore[reportArgumentType]


def _given(of: ReadingAdaptation, reading: Reading, rows: Label) -> _Lane:
    valid = np.asarray(rows.valid)
    reading.read_in_batches(*(np.asarray(part)[valid] for part in (rows.obs, rows.action, rows.answer)))
    return _Lane(reading.result(), rows, [])


def _judged(
    of: ReadingAdaptation, lanes: Lanes, how: Judging, found: list[_Lane], labels: Label | None, watch: Any
) -> AdaptationResult:
    results = tuple(lane.result for lane in found)
    block = Evidence(
        base=jnp.asarray(lanes.base),
        correction=_stacked([one.policy.correction for one in results]),
        labels=_padded([lane.rows for lane in found]) if labels is None else labels,
        asked=jnp.asarray(lanes.budget),
        bound=jnp.asarray(actions_of(of.env).from_unit(lanes.bound_deg)),
        corrects=jnp.asarray(np.array([one.changed for one in results])),
        failed=jnp.zeros(lanes.number, bool),
    )
    judge = Judge(of, lanes, how, lane_mesh(jax.local_devices()[:1]), watch)
    if how.every and how.env is not None:
        for step in range(max(len(lane.policies) for lane in found)):
            then = [lane.policies[min(step, len(lane.policies) - 1)].correction for lane in found]
            asked = np.minimum(step * max(LEAST_BATCH, -(-lanes.budget // BATCHES)), lanes.budget)
            judge.measure(block.replace(correction=_stacked(then), asked=jnp.asarray(asked)))
    if how.by == LABELS:
        if how.env is not None:
            judge.measure(block)
        nothing, unknown = np.zeros(lanes.number), np.full((lanes.number, 3), np.nan)
        evidence, used = (np.array([getattr(one, name) for one in results]) for name in ("evidence", "used"))
        judged = Judgement(LABELS, nothing, evidence, used, lanes.bound_deg, unknown, nothing.astype(int))
    else:
        judged, block = judge.judge_lanes(block)
    return AdaptationResult(of, lanes, _without(of, block, judged.used), judged, judge.curve, results)


def _stacked(corrections: list[Correction]) -> Correction:
    """Return corrections side by side; those of fewer labels get situations without weight."""
    most = max(len(one.known) for one in corrections)

    def filled(one: Correction) -> Correction:
        short = most - len(one.known)
        pad = lambda rows: jnp.concatenate([rows, jnp.zeros((short, rows.shape[1]))])  # noqa: E731
        return one.replace(known=pad(one.known), alpha=pad(one.alpha))

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(filled, corrections))


def _without(of: ReadingAdaptation, block: Evidence, used: np.ndarray) -> Evidence:
    """Return lanes whose correction changes nothing where it is not used."""
    size = block.correction.known.shape[-2]
    mixed = block.correction.frame.mixed.shape[-1]
    nothing = unread(None, actions_of(of.env), of.family, block.correction.frame.mean.shape[-1], size, mixed).correction
    keep = jnp.asarray(used)

    def chosen(own: Array, none: Array) -> Array:
        return jnp.where(keep.reshape(-1, *[1] * none.ndim), own, none)

    return block.replace(correction=jax.tree.map(chosen, block.correction, nothing))


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
        told = [*result.words(), _verdict(judged, lane, result)]
        lines += [f"{lanes.budget[lane]} labels{several}: {line}" for line in told if line]
    return lines


def _verdict(judged: Judgement, lane: int, result: Result) -> str:
    """Return the sentence that says whether the correction is used, and why."""
    end = "the correction is used" if judged.used[lane] else "not shown to be better, so the policy stays as it was"
    if not result.changed:
        return ""
    if judged.by == LABELS:
        factor = np.exp(min(judged.after[lane], 50.0))
        return f"answers predicted before they were read: {factor:.3g} times as likely as without a change; {end}"
    values = f"{judged.by} on tuning episodes {judged.before[lane]:.4g} before, {judged.after[lane]:.4g} after"
    return f"{values} ({judged.rewarded_steps[lane]:,} rewarded steps); {end}"


def to_json(results: tuple[Result, ...]) -> list[dict[str, Any]]:
    """Return the results as JSON values, without their policies."""
    kept = ("used", "changed", "evidence", "depends", "wrong")
    return [
        {name: getattr(one, name) for name in kept} | {"estimates": [estimate._asdict() for estimate in one.estimates]}
        for one in results
    ]
