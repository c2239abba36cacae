"""A Gymnasium environment as a pure function of an episode's seed and the actions so far."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt

from cuelearner_jax import user_code
from cuelearner_jax.bridges.gymnasium.instances import PLACE_BYTES, Request
from cuelearner_jax.bridges.gymnasium.pool import pool_of
from cuelearner_jax.bridges.gymnasium.source import Source
from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import Step

SUCCESS, RETURN = "success", "return"
NOWHERE = bytes(PLACE_BYTES)


class Episode(struct.PyTreeNode):
    """Everything that an episode depends on, and the name of its current place (see `instances`)."""

    seed: UInt[Array, ""]
    steps: Int[Array, ""]  # taken so far
    actions: Float[Array, "max_steps action"]  # taken so far; rows from `steps` on mean nothing
    place: UInt[Array, "2"]


class GymnasiumTask(WholeObservations, struct.PyTreeNode):
    """The environment (`cuelearner_jax.environment.Environment`). Nothing of Gymnasium is loaded until it is reset.

    A step leaves the compiled program (`jax.pure_callback`): an instance that stands where the state says executes the
    action. Where none does, one is reset to the episode's seed and repeats the actions so far.
    """

    source: Source = struct.field(pytree_node=False)
    observation: tuple[Quantity, ...] = struct.field(pytree_node=False)
    actions: Space = struct.field(pytree_node=False)
    succeeds: bool = struct.field(pytree_node=False, default=False)  # True if it reports success
    plays_once: ClassVar[bool] = True

    def reset(self, key: PRNGKeyArray) -> tuple[Episode, Float[Array, " obs"]]:
        """Begin an episode with a seed drawn from the key."""
        seed, (vector, *_, place) = _seed(key), self._shapes
        obs, place = jax.pure_callback(self._reset_here, (vector, place), seed, vmap_method="broadcast_all")
        blank = jnp.zeros((self.source.max_steps, self.actions.size), jnp.float32)
        return Episode(seed, jnp.zeros((), jnp.int32), blank, place), obs

    def step(self, key: PRNGKeyArray, state: Episode, action: Float[Array, " action"]) -> tuple[Episode, Step]:
        """Execute an action. Where that ends the episode, another begins with a seed drawn from the key."""
        next_seed, action = _seed(key), jnp.asarray(action, jnp.float32)
        before = (state.seed, state.steps, state.actions, state.place, action, next_seed)
        results = jax.pure_callback(self._step_here, self._shapes, *before, vmap_method="broadcast_all")
        obs, final_obs, reward, terminated, truncated, success, total, place = results
        ended = terminated | truncated
        after = Episode(
            jnp.where(ended, next_seed, state.seed),
            jnp.where(ended, 0, state.steps + 1),
            state.actions.at[state.steps].set(action),
            place,
        )
        outcome = {**({SUCCESS: success} if self.succeeds else {}), RETURN: total}
        return after, Step(obs, final_obs, final_obs, reward, terminated, truncated, {}, outcome)

    @property
    def _shapes(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        """Shapes of the columns of `Went`."""
        vector, number = jax.ShapeDtypeStruct((self.obs_size,), jnp.float32), jax.ShapeDtypeStruct((), jnp.float32)
        flag, place = jax.ShapeDtypeStruct((), jnp.bool_), jax.ShapeDtypeStruct((2,), jnp.uint32)
        return vector, vector, number, flag, flag, number, number, place

    def _reset_here(self, seed: Any) -> tuple[np.ndarray, np.ndarray]:
        """Reset on the host: any leading axes."""
        seeds = np.asarray(seed)
        requests = {row: Request(one) for row, one in enumerate(seeds.ravel().tolist())}
        obs, *_, place = self._carried(seeds.shape, requests)
        return obs, place

    def _step_here(self, *before: Any) -> tuple[np.ndarray, ...]:
        """Step on the host: any leading axes."""
        seeds, steps, history, places, actions, next_seeds = map(np.asarray, before)
        shape = seeds.shape
        seeds, steps, next_seeds = (column.ravel().tolist() for column in (seeds, steps, next_seeds))
        history, actions = history.reshape(-1, *history.shape[-2:]), actions.reshape(-1, actions.shape[-1])
        places = [row.tobytes() for row in np.ascontiguousarray(places).reshape(-1, 2)]
        # What is no action is not executed, and what comes of nothing stays nothing.
        rows = [row for row in np.flatnonzero(np.isfinite(actions).all(-1)).tolist() if places[row] != NOWHERE]
        past = lambda row: history[row, : steps[row]]  # noqa: E731
        requests = {row: Request(seeds[row], places[row], actions[row], next_seeds[row], past(row)) for row in rows}
        return self._carried(shape, requests)

    def _carried(self, shape: tuple[int, ...], requests: dict[int, Request]) -> tuple[Any, ...]:
        """Return the results of requests, column by column; NaN where there is none, and after a failure.

        `user_code` then reports the failure.
        """
        rows = math.prod(shape)
        blank = {np.float32: np.nan, np.bool_: False, np.uint32: 0}
        columns = [np.full((rows, *one.shape), blank[one.dtype.type], one.dtype) for one in self._shapes]
        if requests and not user_code.is_waiting():
            try:
                results = pool_of(self.source).carry_out(requests)
            except BaseException as error:  # one that left the compiled program would be an error of XLA's
                user_code.leave(error)
            else:
                results = [one._replace(place=np.frombuffer(one.place, np.uint32)) for one in results]  # pyright: ignore
                for column, values in zip(columns, zip(*results, strict=True), strict=True):
                    column[list(requests)] = values
        return tuple(column.reshape((*shape, *column.shape[1:])) for column in columns)


def _seed(key: PRNGKeyArray) -> UInt[Array, ""]:
    """Return a seed below 2^31, which every environment accepts."""
    return jax.random.bits(key, (), jnp.uint32) >> 1
