"""One ring buffer: steps as packed float32 rows, so that sampling is a single gather.

The write position follows from the shared step counter and is therefore no part of the (vmapped) state: under vmap the
write stays one in-place slice update.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.custom_batching
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.types import StoredStep


class Following(NamedTuple):
    """A stored step and those that came after it in the same environment, some of them perhaps of a later episode."""

    rewards: Float[Array, "batch n"]
    discounts: Float[Array, "batch n"]
    ended: Float[Array, "batch n"]
    known: Bool[Array, "batch n"]  # False past the newest step


class RingBuffer(NamedTuple):
    """Pure functions over rows (capacity, width). `step`: rows written so far, also those written over since."""

    width: int
    empty: Callable[[int], Float[Array, "capacity width"]]
    add: Callable[[Array, Array, StoredStep], Array]  # (rows, step, steps (n, ...)) -> rows
    draw: Callable[[PRNGKeyArray, Array, Array, int], Array]  # (key, rows, step, batch_size) -> rows' numbers
    read: Callable[[Array, Array], StoredStep]  # (rows, numbers (batch,)) -> steps (batch, ...)
    follow: Callable[
        [Array, Array, Array, int, int], Following
    ]  # (rows, step, numbers (batch,), n, num_envs) -> Following


@jax.custom_batching.custom_vmap
def _write(
    rows: Float[Array, "*lanes capacity width"], packed: Float[Array, "*lanes n width"], start: Int[Array, ""]
) -> Float[Array, "*lanes capacity width"]:
    """`packed` in place of the rows from `start` on."""
    zero = jnp.zeros_like(start)
    return jax.lax.dynamic_update_slice(rows, packed, (*[zero] * (rows.ndim - 2), start, zero))


@_write.def_vmap
def _write_lanes(axis_size: int, batched: list[bool], rows: Array, packed: Array, start: Array) -> tuple[Array, bool]:
    """One slice update for all lanes; JAX's own rule would make it a scatter."""
    if batched != [True, True, False]:
        raise ValueError("lanes have rows of their own and one step counter: vmap over rows and transitions alone")
    return _write(rows, packed, start), True


def ring_buffer(example: StoredStep) -> RingBuffer:
    """Builds the buffer for steps shaped like `example`.

    `add` requires the capacity to be a multiple of the number of steps added at once: one of each environment. So the
    next step of an environment lies that many rows further.
    """
    row, unravel = ravel_pytree(example)
    width = row.shape[0]
    reward_column = example.obs.size + example.action.size  # the fields lie in the order of their declaration

    def empty(capacity: int) -> Float[Array, "capacity width"]:
        return jnp.zeros((capacity, width), jnp.float32)

    def add(
        rows: Float[Array, "capacity width"], step: Int[Array, ""], steps: StoredStep
    ) -> Float[Array, "capacity width"]:
        packed = jax.vmap(lambda item: ravel_pytree(item)[0])(steps)
        if rows.shape[0] % packed.shape[0]:
            raise ValueError(f"capacity {rows.shape[0]} is no multiple of the {packed.shape[0]} steps added")
        return _write(rows, packed.astype(rows.dtype), jnp.mod(step, rows.shape[0]))

    def draw(
        key: PRNGKeyArray, rows: Float[Array, "capacity width"], step: Int[Array, ""], batch_size: int
    ) -> Int[Array, " batch"]:
        return jax.random.randint(key, (batch_size,), 0, jnp.clip(step, 1, rows.shape[0]))

    def read(rows: Float[Array, "capacity width"], numbers: Int[Array, " batch"]) -> StoredStep:
        return jax.vmap(unravel)(rows[numbers])

    def follow(
        rows: Float[Array, "capacity width"], step: Int[Array, ""], numbers: Int[Array, " batch"], n: int, num_envs: int
    ) -> Following:
        capacity = rows.shape[0]
        further = jnp.arange(n) * num_envs
        newer = jnp.mod(step - 1 - numbers, capacity)  # rows written after each
        places = jnp.mod(numbers[:, None] + further[None], capacity)
        # Three neighbouring numbers of each row, not the row.
        found = rows[places[..., None], reward_column + jnp.arange(3)[None, None]]
        return Following(*jnp.moveaxis(found, -1, 0), known=further[None] <= newer[:, None])

    return RingBuffer(width, empty, add, draw, read, follow)
