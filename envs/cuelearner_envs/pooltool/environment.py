"""Billiards with every shot played by pooltool: same table, balls, observation and reward, other physics."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.billiards.config import BilliardsConfig
from cuelearner_envs.billiards.config import make_environment as make_billiards
from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.physics import Shot
from cuelearner_envs.billiards.table import CORNER_GAP, Table, parking
from cuelearner_envs.pooltool.outline import Outline
from cuelearner_envs.pooltool.processes import play_many
from cuelearner_jax.errors import UserError

# With it a free ball comes to rest after 1.3 m, as on our table, where it leaves with 0.5 m/s [m/s].
STRIKE_SPEED = 0.7


class PooltoolBilliards(Billiards, kw_only=True):
    """The environment (`cuelearner_jax.environment.Environment`), with the interface of `Billiards`.

    A shot leaves the compiled program (`jax.pure_callback`) and is played in other processes. Of the table's constants
    sizes alone count; friction, restitution and drag are pooltool's.
    """

    outline: Outline = struct.field(pytree_node=False)
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
        call = partial(_played, self.outline, self.processes)
        positions, *rest = jax.pure_callback(
            call, shapes, balls.positions, balls.pocketed, angle, vmap_method="broadcast_all"
        )
        places = jnp.where(rest[0][:, None], parking(self.table), positions)
        return Shot(places.astype(jnp.float32), *rest)


def _played(
    outline: Outline, processes: int, positions: Array, pocketed: Array, angle: Array
) -> tuple[np.ndarray, ...]:
    """Shots with any leading axes."""
    leading, balls = np.shape(angle), np.shape(pocketed)[-1]
    found = play_many(
        outline,
        np.asarray(positions).reshape(-1, balls, 2),
        np.asarray(pocketed).reshape(-1, balls),
        np.asarray(angle).reshape(-1),
        processes,
    )
    return tuple(column.reshape((*leading, *column.shape[1:])) for column in found)


def make_environment(config: BilliardsConfig) -> PooltoolBilliards:
    """The world that a configuration describes, in pooltool. Raises UserError if it can't be."""
    if find_spec("pooltool") is None:
        raise UserError("pooltool is not installed: pip install 'cuelearner-jax[pooltool]'")
    plain = make_billiards(config)
    if any(config.acceleration):
        raise UserError("pooltool's table is level: leave out --task.acceleration")
    return PooltoolBilliards(
        table=plain.table,
        action_turn=plain.action_turn,
        observation_bias=plain.observation_bias,
        max_shots=plain.max_shots,
        mirrors=plain.mirrors,
        outline=outline_of(getattr(Table, config.table)()),
    )


def outline_of(table: Table) -> Outline:
    """A table's sizes, with the strike of here."""
    return Outline(
        width=float(table.width),
        height=float(table.height),
        ball_radius=float(table.ball_radius),
        hole_width=float(table.hole_width),
        corner_gap=CORNER_GAP * float(table.hole_width),
        cushion_radius=float(table.cushion_radius),
        pocket_margin=float(table.pocket_margin),
        side_pockets=table.side_pockets,
        strike_speed=STRIKE_SPEED,
    )
