"""Adaptation by a reading of relative answers, one lane after another, outside compiled programs.

of = ReadingAdaptation(guide, sizes, scalars, env, bases, family)
result = adapt(of, lanes, Judging(None, by="labels"), teacher)
result.results[0].words(), result.policy(env)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.adaptation.by_model import AdaptationResult, result_of
from cuelearner_jax.adaptation.judging import Judge, Judging
from cuelearner_jax.adaptation.lanes import Adaptation, Lanes
from cuelearner_jax.asking import fitted_labels
from cuelearner_jax.config import GuideScalars
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.environment import actions_of
from cuelearner_jax.evaluate import Tell, ignore_progress
from cuelearner_jax.reading import Reading, ReadingPolicy, Walk
from cuelearner_jax.reading.families import Family
from cuelearner_jax.reading.fitting import pick
from cuelearner_jax.reading.policy import Correction, unread
from cuelearner_jax.reading.session import BATCHES, LEAST_BATCH
from cuelearner_jax.types import Label, Teacher

USUAL = 100  # default number of labels
LEAST = 2 * LEAST_BATCH  # labels: those of the first batch say nothing for or against a correction
CHOICE = 6  # situations met for each question


class ReadingAdaptation(Adaptation):
    """The world, base policies and family that all lanes of a reading share."""

    family: Family = struct.field(pytree_node=False)  # possible changes; empty: shifts of entries of the observation
    reference: str = struct.field(pytree_node=False, default="")  # the code of it; empty: the world declares it

    def policy(self, block: Any, env: Any = None) -> ReadingPolicy:
        """Return every lane's corrected policy."""
        base, space = self.bases.lane(block.base), actions_of(self.env)
        return ReadingPolicy(base, block.correction, block.bound, space, self.family, self.reference)

    def drop_unused(self, block: Any, in_use: Bool[Array, " lanes"]) -> Any:
        """Return the lanes, without a correction where it is not used."""
        nothing = self.unread(None, block.correction).correction
        keep = jax.vmap(lambda in_use, own: jax.tree.map(partial(jnp.where, in_use), own, nothing))
        return block.replace(correction=keep(jnp.asarray(in_use), block.correction))

    def unread(self, base: Any, like: Correction | None = None) -> ReadingPolicy:
        """Return a policy that corrects nothing; `like`: a correction with the sizes of its arrays."""
        labels, mixed = (0, 0) if like is None else (like.known.shape[-2], like.frame.mixed.shape[-1])
        return unread(base, actions_of(self.env), self.family, self.env.obs_size, labels, mixed)


class ReadingLanes(struct.PyTreeNode):
    """A block of lanes with their answers and corrections."""

    base: Int[Array, " lanes"]
    correction: Correction  # (lanes, ...)
    labels: Label  # (lanes, slots, ...)
    bound: Float[Array, " lanes"]
    corrects: Bool[Array, " lanes"]  # True where the answers show a change
    failed: Bool[Array, " lanes"]


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
    rows, results, total_before = [], [], 0
    for base, seed, budget, bound in zip(*(column.tolist() for column in lanes), strict=True):
        observation = getattr(of.env, "observation", ())
        within = bound if bound < space.reach else np.inf
        reading = Reading(of.bases.lane(base), of.family, space, float(of.scalars.eps_deg), budget, observation, within)
        if labels is None:
            assert teacher is not None
            progress = lambda count, before=total_before: tell(before + count, total)  # noqa: E731
            own = ask_in_batches(reading, Walk(of.env, teacher, of.scalars), seed, budget, progress)
        else:
            own = jax.tree.map(lambda leaf: np.asarray(leaf)[len(rows)], labels)
            reading.read_in_batches(*_valid(jax.random.key(seed), own, of.scalars))
        rows.append(own)
        results.append(reading.result())
        total_before += budget
        tell(total_before, total)
    block = ReadingLanes(
        base=jnp.asarray(lanes.base),
        correction=_side_by_side([one.policy.correction for one in results]),
        labels=_side_by_side(rows) if labels is None else labels,
        bound=jnp.asarray(space.from_unit(lanes.bound_deg)),
        corrects=jnp.asarray(np.array([one.changed for one in results])),
        failed=jnp.zeros(lanes.number, bool),
    )
    judge = Judge(of, lanes, how, lane_mesh(jax.local_devices()[:1]), watch)
    return result_of(judge, block, lanes.number, tuple(results))


def ask_in_batches(
    reading: Reading, walk: Walk, seed: int, budget: int, tell: Callable[[int], None] = lambda count: None
) -> Label:
    """Return one lane's labels, asked and read in batches. Raises UserError for a failing world or teacher."""
    rows, key, size = [], jax.random.key(seed), max(LEAST_BATCH, -(-budget // BATCHES))
    for start in range(0, budget, size):
        tell(start)
        key, k_where, k_ask, k_answer = jax.random.split(key, 4)
        states, obs = walk.situations(k_where, reading.policy(), CHOICE * size)
        index, action = reading.questions(np.asarray(obs), min(size, budget - start), k_ask)
        states, obs = pick((states, obs), index)
        answer, valid = map(np.asarray, walk.answers(k_answer, states, obs, jnp.asarray(action)))
        user_code.check_actions(answer[valid], f"teacher {type(walk.teacher).__name__}")
        rows.append(Label(np.asarray(obs), action, np.where(valid[:, None], answer, 0), valid))  # pyright: ignore[reportArgumentType]
        reading.learn(*_valid(k_answer, rows[-1], walk.scalars))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *rows)


def _valid(key: PRNGKeyArray, labels: Label, scalars: GuideScalars) -> list[np.ndarray]:
    """Return situations, actions and answers of the valid labels, in the control with exchanged answers."""
    labels = fitted_labels(key, jax.tree.map(jnp.asarray, labels), scalars)
    return [np.asarray(part)[labels.valid] for part in (labels.obs, labels.action, labels.answer)]


def _side_by_side(trees: list[Any]) -> Any:
    """Return trees side by side; rows that one has fewer of are zero: without weight, or not valid."""

    def stack(*leaves: Any) -> Array:
        if not np.ndim(leaves[0]):
            return jnp.stack(leaves)
        most, rest = max(map(len, leaves)), [(0, 0)] * (np.ndim(leaves[0]) - 1)
        return jnp.stack([jnp.pad(jnp.asarray(leaf), [(0, most - len(leaf)), *rest]) for leaf in leaves])

    return jax.tree.map(stack, *trees)
