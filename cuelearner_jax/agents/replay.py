"""Replay: steps as packed float32 rows of one ring buffer, so that sampling is a single gather.

The write position follows from the shared step counter and is therefore no part of the (vmapped) state: under vmap the
write stays one in-place slice update.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.custom_batching
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Num, PRNGKeyArray

from cuelearner_jax.environment import Environment, actions_of, random_symmetries
from cuelearner_jax.types import Action, Number, Observation, Step


class StoredStep(struct.PyTreeNode):
    """One step in replay, as small as the environment can make it."""

    obs: Float[Array, " memory"]  # see `Environment.remember`
    action: Action  # as executed
    reward: Float[Array, ""]
    discount: Float[Array, " 1_or_0"]  # this and the next two have no entries where nothing bootstraps
    ended: Float[Array, " 1_or_0"]  # 1 where the episode ended, terminated or truncated
    aftermath: Float[Array, " aftermath_or_0"]  # see `Environment.recall_next`


class Transition(struct.PyTreeNode):
    """One step to learn from. `next_obs` has no entries where nothing bootstraps from it (discount 0)."""

    obs: Observation
    action: Action  # as executed
    reward: Float[Array, ""]
    # discount of the value of `next_obs`: 0 at termination, never at truncation; 1 after one step
    discount: Float[Array, ""]
    next_obs: Float[Array, " obs_or_0"]
    # what critics see beside the two observations; None: nothing
    privileged: tuple[Float[Array, " privileged"], Float[Array, " privileged_or_0"]] | None = None


class LaterSteps(NamedTuple):
    """A stored step and those that came after it in the same environment, some of them perhaps of a later episode."""

    rewards: Float[Array, "batch n"]
    discounts: Float[Array, "batch n"]
    ended: Float[Array, "batch n"]
    exists: Bool[Array, "batch n"]  # False past the newest step


@jax.custom_batching.custom_vmap
def _write(
    rows: Num[Array, "*lanes capacity width"], packed: Num[Array, "*lanes n width"], start: Int[Array, ""]
) -> Num[Array, "*lanes capacity width"]:
    zero = jnp.zeros_like(start)
    return jax.lax.dynamic_update_slice(rows, packed, (*[zero] * (rows.ndim - 2), start, zero))


@_write.def_vmap
def _write_lanes(axis_size: int, batched: list[bool], rows: Array, packed: Array, start: Array) -> tuple[Array, bool]:
    """Write one slice update for all lanes; JAX's own batching rule would make it a scatter."""
    if batched != [True, True, False]:
        raise ValueError("lanes have rows of their own and one step counter: vmap over rows and transitions alone")
    return _write(rows, packed, start), True


class RingBuffer:
    """Pure functions over rows (capacity, width) of packed steps. `step`: all rows written so far, overwritten too."""

    def __init__(self, example: StoredStep) -> None:
        row, self._unravel = ravel_pytree(example)
        self.width = row.shape[0]
        self._reward_column = example.obs.size + example.action.size  # the fields lie in the order of their declaration

    def empty(self, capacity: int) -> Float[Array, "capacity width"]:
        """Return rows of zeros."""
        return jnp.zeros((capacity, self.width), jnp.float32)

    def pack(self, steps: StoredStep) -> Float[Array, "n width"]:
        """Return steps (n, ...) as rows."""
        return jax.vmap(lambda item: ravel_pytree(item)[0])(steps).astype(jnp.float32)

    def add(
        self, rows: Float[Array, "capacity width"], step: Int[Array, ""], steps: StoredStep
    ) -> Float[Array, "capacity width"]:
        """Return the rows with steps (n, ...), one of each environment; n must divide the capacity.

        So the next step of an environment lies n rows further.
        """
        packed = self.pack(steps)
        if rows.shape[0] % packed.shape[0]:
            raise ValueError(f"capacity {rows.shape[0]} is no multiple of the {packed.shape[0]} steps added")
        return _write(rows, packed, jnp.mod(step, rows.shape[0]))

    def draw(self, key: PRNGKeyArray, rows: Array, step: Int[Array, ""], batch_size: int) -> Int[Array, " batch"]:
        """Draw numbers of rows."""
        return jax.random.randint(key, (batch_size,), 0, jnp.clip(step, 1, rows.shape[0]))

    def read(self, rows: Float[Array, "capacity width"], numbers: Int[Array, " batch"]) -> StoredStep:
        """Return the steps (batch, ...) in rows."""
        return jax.vmap(self._unravel)(rows[numbers])

    def follow(
        self, rows: Array, step: Int[Array, ""], numbers: Int[Array, " batch"], n: int, num_envs: int
    ) -> LaterSteps:
        """Return the steps in rows and the n - 1 steps that follow each in its environment."""
        capacity = rows.shape[0]
        further = jnp.arange(n) * num_envs
        newer = jnp.mod(step - 1 - numbers, capacity)  # rows written after each
        places = jnp.mod(numbers[:, None] + further[None], capacity)
        # Three neighbouring numbers of each row, not the row.
        later = rows[places[..., None], self._reward_column + jnp.arange(3)[None, None]]
        return LaterSteps(*jnp.moveaxis(later, -1, 0), exists=further[None] <= newer[:, None])


class Memory(NamedTuple):
    """One lane's replay, to draw minibatches from."""

    env: Any  # rebuilds observations
    buffer: RingBuffer
    rows: Float[Array, "capacity width"]
    filled: Int[Array, ""]  # rows written so far
    num_envs: int
    bootstraps: bool  # whether transitions have a next observation
    guided: Int[Array, "capacity 1"] | None = None  # counts of `count_guided`; None: guided steps are not counted
    labelled: Memory | None = None  # labelled steps, one environment's; None: none are kept

    def batches(
        self, key: PRNGKeyArray, size: int, n_step: int = 1, discount: Number = 0.0, guided_share: Number | None = None
    ) -> list[Transition]:
        """Draw transitions (size,), each under a random symmetry of the environment.

        With `n_step` above 1 a second batch follows: from the same steps on, up to so many of one episode as one.
        All stored steps are as likely; with a `guided_share` the first of a batch, up to that share, are labelled
        steps or else guided steps, and the others own steps, each sort as likely. A sort without steps leaves its place
        to the other.
        """
        k_sample, k_mirror = jax.random.split(key)
        batches = self._draw(k_sample, size, n_step, discount, guided_share)
        if self.labelled is not None:
            k_labelled, k_choice = jax.random.split(jax.random.fold_in(k_sample, 1))
            labelled = self.labelled._draw(k_labelled, size, n_step, discount, None)
            places = self._labelled_places(k_choice, size, guided_share)
            pick = lambda one, other: jnp.where(places.reshape(-1, *[1] * (one.ndim - 1)), one, other)  # noqa: E731
            batches = [jax.tree.map(pick, *both) for both in zip(labelled, batches, strict=True)]
        return [apply_symmetries(k_mirror, self.env, batch) for batch in batches]

    def _draw(self, key: PRNGKeyArray, size: int, n_step: int, discount: Any, guided_share: Any) -> list[Transition]:
        """Return the batches of `batches`, of this memory's own rows and without symmetries."""
        if guided_share is None or self.guided is None:
            numbers = self.buffer.draw(key, self.rows, self.filled, size)
        else:
            is_chosen = jnp.arange(size) < jnp.round(guided_share * size)
            numbers = draw_sorts(key, self.guided[:, 0], self.filled, is_chosen)
        batches = [self.one_step(self.buffer.read(self.rows, numbers))]
        if n_step > 1:
            batches.append(self.n_step(numbers, n_step, discount))
        return batches

    def _labelled_places(self, key: PRNGKeyArray, size: int, guided_share: Any) -> Bool[Array, " batch"]:
        """Return the places of a batch for labelled steps: a share in front, or at random, as often as other steps."""
        assert self.labelled is not None
        there = self.labelled.filled
        if guided_share is not None:
            return (jnp.arange(size) < jnp.round(guided_share * size)) & (there > 0)
        return jax.random.uniform(key, (size,)) * (there + jnp.clip(self.filled, 1, self.rows.shape[0])) < there

    def one_step(self, stored: StoredStep) -> Transition:
        """Return stored steps (batch, ...) as transitions, with their observations rebuilt."""
        if self.bootstraps:
            next_obs = jax.vmap(self.env.recall_next)(stored.obs, stored.action, stored.aftermath)
            discount = stored.discount[:, 0]
        else:
            next_obs, discount = jnp.zeros((stored.reward.shape[0], 0)), jnp.zeros_like(stored.reward)
        count, obs = getattr(self.env, "privileged", 0), jax.vmap(self.env.recall)(stored.obs)
        privileged = (stored.obs[:, -count:], stored.aftermath[:, -count:]) if count else None
        return Transition(obs, stored.action, stored.reward, discount, next_obs, privileged)

    def n_step(self, numbers: Int[Array, " batch"], n: int, discount: Number) -> Transition:
        """Return the transitions that begin at rows `numbers` and span up to n steps of one episode."""
        after = self.buffer.follow(self.rows, self.filled, numbers, n, self.num_envs)
        summed = jax.vmap(partial(n_step_return, discount=discount))
        reward, factor, last = summed(after.rewards, after.discounts, after.ended, after.exists)
        ends = jnp.mod(numbers + last * self.num_envs, self.rows.shape[0])
        first, end = (self.one_step(self.buffer.read(self.rows, rows)) for rows in (numbers, ends))
        privileged = first.privileged and end.privileged and (first.privileged[0], end.privileged[1])
        return first.replace(reward=reward, discount=factor, next_obs=end.next_obs, privileged=privileged)


def count_guided(
    counts: Int[Array, "capacity 1"], step: Int[Array, ""], guided: Bool[Array, " n"]
) -> Int[Array, "capacity 1"]:
    """Count guided steps beside the rows of a ring buffer: of all steps made up to each row, that row included.

    `counts`: 0 at first; `step`: see `RingBuffer`; `guided`: which of the steps being added the guide chose.
    """
    added = counts[jnp.mod(step - 1, counts.shape[0]), 0] + jnp.cumsum(guided.astype(counts.dtype))
    return _write(counts, added[:, None], jnp.mod(step, counts.shape[0]))


def draw_sorts(
    key: PRNGKeyArray, counts: Int[Array, " capacity"], filled: Int[Array, ""], guided: Bool[Array, " batch"]
) -> Int[Array, " batch"]:
    """Draw numbers of rows of one sort each, every row of a sort as likely.

    A row is found by its rank among those of its sort, by bisection in the `counts` of `count_guided`. Once rows are
    written over, the oldest is left out: the count before it, which told its sort, is gone.

    `filled`: rows written so far, also those written over since. `guided`: which of the numbers are to be of guided
    steps, the others of own ones; of a sort without rows the numbers are of the other.
    """
    capacity = counts.shape[0]
    lost = jnp.maximum(filled - capacity, 0)
    first = jnp.where(lost > 0, lost + 1, 0)
    before = jnp.where(lost > 0, counts[jnp.mod(lost, capacity)], 0)
    among = filled - first
    counted = counts[jnp.mod(filled - 1, capacity)] - before
    guided = jnp.where(counted == 0, False, jnp.where(counted == among, True, guided))
    rank = jax.random.randint(key, guided.shape, 0, jnp.maximum(jnp.where(guided, counted, among - counted), 1)) + 1

    def halve(_: Int[Array, ""], ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low + high) // 2
        of_guide = counts[jnp.mod(first + middle, capacity)] - before
        reached = jnp.where(guided, of_guide, middle + 1 - of_guide) >= rank
        return jnp.where(reached, low, middle + 1), jnp.where(reached, middle, high)

    start = jnp.zeros_like(rank), jnp.broadcast_to(jnp.maximum(among - 1, 0), rank.shape)
    place, _ = jax.lax.fori_loop(0, capacity.bit_length(), halve, start)
    return jnp.mod(first + place, capacity)


def n_step_return(
    rewards: Float[Array, " n"],
    discounts: Float[Array, " n"],
    ended: Float[Array, " n"],
    exists: Bool[Array, " n"],
    discount: Number,
) -> tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""]]:
    """Return the discounted rewards of up to n steps of one episode (Sutton and Barto, 2018, Eq. 7.1).

    The sum stops with the episode's last step, or with the last step that is `exists`; `discounts` is 0 at termination,
    else 1. Returns the sum; the factor of the value of the last step's next observation, short of one `discount`, as
    `Transition.discount` has it; the last step's index.
    """
    counts = jnp.cumprod(jnp.concatenate([jnp.ones(1), 1.0 - ended[:-1]])) * exists
    powers = jnp.power(jnp.asarray(discount, rewards.dtype), jnp.arange(rewards.shape[0]))
    last = counts.sum().astype(jnp.int32) - 1
    return jnp.sum(counts * powers * rewards), powers[last] * discounts[last], last


def buffer_for(env: Environment, bootstraps: bool) -> RingBuffer:
    """Return the ring buffer for an environment's steps; shapes in place of arrays will do."""
    size = actions_of(env).size

    def one_step(env: Environment, key: PRNGKeyArray) -> StoredStep:
        state, obs = env.reset(key)
        action = jnp.zeros(size)
        return stored_step(env.remember(state, obs), action, env.step(key, state, action)[1], bootstraps)

    shapes = jax.eval_shape(one_step, env, jax.random.key(0))
    return RingBuffer(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes))


def stored_step(obs: Float[Array, " memory"], action: Action, step: Step, bootstraps: bool) -> StoredStep:
    """Return what replay stores of one step from the remembered observation `obs`."""
    entries = slice(None) if bootstraps else slice(0)
    flags = step.terminated, step.terminated | step.truncated
    terminated, ended = (flag[None].astype(jnp.float32)[entries] for flag in flags)
    return StoredStep(obs, action, step.reward, 1.0 - terminated, ended, step.aftermath[entries])


def apply_symmetries(key: PRNGKeyArray, env: Environment, batch: Transition) -> Transition:
    """Return each transition of a batch under a random symmetry of the environment, unless critics see more."""
    if batch.privileged is not None:  # nobody says how that is mirrored
        return batch
    image = random_symmetries(key, env, batch.reward.shape[0])
    obs, action = image(batch.obs, batch.action)
    next_obs = image(batch.next_obs, batch.action)[0] if batch.next_obs.shape[-1] else batch.next_obs
    return batch.replace(obs=obs, action=action, next_obs=next_obs)
