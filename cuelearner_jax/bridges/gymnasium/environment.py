"""A Gymnasium environment as a pure function of an episode's seed and the actions so far."""

from __future__ import annotations

import math
from typing import Any

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
from cuelearner_jax.errors import UserError
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
    refusal: str = struct.field(pytree_node=False, default="")  # reason why it cannot be made; empty: it can

    def reset(self, key: PRNGKeyArray) -> tuple[Episode, Float[Array, " obs"]]:
        """Begin an episode with a seed drawn from the key. Raises UserError where the environment cannot be made."""
        self._check()
        seed = _seed(key)
        shapes = (self._vector, jax.ShapeDtypeStruct((2,), jnp.uint32))
        obs, place = jax.pure_callback(self._reset_here, shapes, seed, vmap_method="broadcast_all")
        blank = jnp.zeros((self.source.max_steps, self.actions.size), jnp.float32)
        return Episode(seed, jnp.zeros((), jnp.int32), blank, place), obs

    def step(self, key: PRNGKeyArray, state: Episode, action: Float[Array, " action"]) -> tuple[Episode, Step]:
        """Execute an action. Where that ends the episode, another begins with a seed drawn from the key."""
        self._check()
        next_seed, number, flag = _seed(key), jax.ShapeDtypeStruct((), jnp.float32), jax.ShapeDtypeStruct((), jnp.bool_)
        place = jax.ShapeDtypeStruct((2,), jnp.uint32)
        shapes = (self._vector, self._vector, number, flag, flag, number, number, place)
        action = jnp.asarray(action, jnp.float32)
        given = (state.seed, state.steps, state.actions, state.place, action, next_seed)
        found = jax.pure_callback(self._step_here, shapes, *given, vmap_method="broadcast_all")
        obs, final_obs, reward, terminated, truncated, success, total, place = found
        ended = terminated | truncated
        after = Episode(
            jnp.where(ended, next_seed, state.seed),
            jnp.where(ended, 0, state.steps + 1),
            state.actions.at[state.steps].set(action),
            place,
        )
        outcome = {**({SUCCESS: success} if self.succeeds else {}), RETURN: total}
        return after, Step(obs, final_obs, final_obs, reward, terminated, truncated, {}, outcome)

    def _check(self) -> None:
        if self.refusal:
            raise UserError(self.refusal)

    @property
    def _vector(self) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((self.obs_size,), jnp.float32)

    def _reset_here(self, seed: Any) -> tuple[np.ndarray, np.ndarray]:
        """Reset on the host: any leading axes."""
        seeds = np.asarray(seed)
        obs, *_, place = self._carried(
            seeds.shape, {row: Request(one) for row, one in enumerate(seeds.ravel().tolist())}
        )
        return obs, place

    def _step_here(self, *given: Any) -> tuple[np.ndarray, ...]:
        """Step on the host: any leading axes."""
        seeds, steps, history, places, actions, next_seeds = map(np.asarray, given)
        shape = seeds.shape
        seeds, steps, next_seeds = (column.ravel().tolist() for column in (seeds, steps, next_seeds))
        history, actions = history.reshape(-1, *history.shape[-2:]), actions.reshape(-1, actions.shape[-1])
        places = [row.tobytes() for row in np.ascontiguousarray(places).reshape(-1, 2)]
        # What is no action is not executed, and what comes of nothing stays nothing.
        rows = [row for row in np.flatnonzero(np.isfinite(actions).all(-1)).tolist() if places[row] != NOWHERE]
        requests = {row: Request(seeds[row], places[row], actions[row], next_seeds[row]) for row in rows}
        return self._carried(shape, requests, lambda row: history[row, : steps[row]])

    def _carried(self, shape: tuple[int, ...], requests: dict[int, Request], history: Any = None) -> tuple[Any, ...]:
        """Return the results of requests, column by column; NaN where there is none, and after a failure.

        `user_code` then reports the failure.
        """
        rows = math.prod(shape)
        obs, final_obs = np.full((2, rows, self.obs_size), np.nan, np.float32)
        reward, success, total = np.full((3, rows), np.nan, np.float32)
        terminated, truncated = np.zeros((2, rows), bool)
        place = np.zeros((rows, 2), np.uint32)
        if requests and not user_code.is_waiting():
            try:
                went = pool_of(self.source).carry_out(requests, history)
            except UserError as error:
                user_code.leave(error)
            else:
                parts = obs, final_obs, reward, terminated, truncated, success, total
                for part, column in zip(parts, zip(*went, strict=True), strict=False):  # all columns but the places
                    part[list(requests)] = column
                place[list(requests)] = np.frombuffer(b"".join(one.place for one in went), np.uint32).reshape(-1, 2)
        columns = obs, final_obs, reward, terminated, truncated, success, total, place
        return tuple(column.reshape((*shape, *column.shape[1:])) for column in columns)


def _seed(key: PRNGKeyArray) -> UInt[Array, ""]:
    """Return a seed below 2^31, which every environment accepts."""
    return jax.random.bits(key, (), jnp.uint32) >> 1
