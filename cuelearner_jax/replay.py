"""One ring buffer: transitions as packed float32 rows, so that sampling is a single gather.

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
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.types import Transition


class RingBuffer(NamedTuple):
    """Pure functions over rows (capacity, width)."""

    width: int
    empty: Callable[[int], Float[Array, "capacity width"]]
    add: Callable[..., Float[Array, "capacity width"]]  # (rows, step, transitions (n, ...)) -> rows
    sample: Callable[..., Transition]  # (key, rows, step, batch_size) -> transitions (batch_size, ...)


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


def ring_buffer(example: Transition) -> RingBuffer:
    """Builds the buffer for transitions shaped like `example`.

    `add` requires the capacity to be a multiple of the number of transitions added at once.
    """
    row, unravel = ravel_pytree(example)
    width = row.shape[0]

    def empty(capacity: int) -> Float[Array, "capacity width"]:
        return jnp.zeros((capacity, width), jnp.float32)

    def add(
        rows: Float[Array, "capacity width"], step: Int[Array, ""], transitions: Transition
    ) -> Float[Array, "capacity width"]:
        packed = jax.vmap(lambda item: ravel_pytree(item)[0])(transitions)
        if rows.shape[0] % packed.shape[0]:
            raise ValueError(f"capacity {rows.shape[0]} is no multiple of the {packed.shape[0]} transitions added")
        return _write(rows, packed.astype(rows.dtype), jnp.mod(step, rows.shape[0]))

    def sample(
        key: PRNGKeyArray, rows: Float[Array, "capacity width"], step: Int[Array, ""], batch_size: int
    ) -> Transition:
        filled = jnp.clip(step, 1, rows.shape[0])
        index = jax.random.randint(key, (batch_size,), 0, filled)
        return jax.vmap(unravel)(rows[index])

    return RingBuffer(width, empty, add, sample)
