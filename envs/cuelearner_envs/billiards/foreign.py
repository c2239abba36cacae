"""Billiards whose shots another engine plays, in processes of its own."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.physics import Shot
from cuelearner_envs.billiards.processes import Engine, play_many
from cuelearner_envs.billiards.table import parking


class ForeignBilliards(Billiards, kw_only=True):
    """The environment (`cuelearner_jax.environment.Environment`), with the interface of `Billiards`.

    A shot leaves the compiled program (`jax.pure_callback`) and is played in other processes. Of the table's constants
    those count that the engine has.
    """

    engine: Engine = struct.field(pytree_node=False)
    processes: int = struct.field(pytree_node=False, default=0)  # that play; 0: one for each processor

    def shot(self, balls: Balls, angle: Float[Array, ""]) -> Shot:
        """Play one shot; batches are distributed among processes."""
        count = self.table.balls
        shapes = (
            jax.ShapeDtypeStruct((count, 2), jnp.float32),
            jax.ShapeDtypeStruct((count,), jnp.bool_),
            jax.ShapeDtypeStruct((), jnp.float32),
            jax.ShapeDtypeStruct((), jnp.int32),
            jax.ShapeDtypeStruct((), jnp.bool_),
        )
        call = partial(_played, self.engine, self.processes)
        positions, *rest = jax.pure_callback(
            call, shapes, balls.positions, balls.pocketed, angle, vmap_method="broadcast_all"
        )
        places = jnp.where(rest[0][:, None], parking(self.table), positions)
        return Shot(places.astype(jnp.float32), *rest)


def _played(engine: Engine, processes: int, positions: Array, pocketed: Array, angle: Array) -> tuple[np.ndarray, ...]:
    """Shots with any leading axes."""
    leading, balls = np.shape(angle), np.shape(pocketed)[-1]
    found = play_many(
        engine,
        np.asarray(positions).reshape(-1, balls, 2),
        np.asarray(pocketed).reshape(-1, balls),
        np.asarray(angle).reshape(-1),
        processes,
    )
    return tuple(column.reshape((*leading, *column.shape[1:])) for column in found)
