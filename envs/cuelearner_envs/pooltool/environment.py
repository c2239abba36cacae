"""Billiards with every shot played by pooltool: same table, balls, observation and reward, other physics."""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

from cuelearner_envs.billiards.config import BilliardsConfig
from cuelearner_envs.billiards.config import make_environment as make_billiards
from cuelearner_envs.billiards.foreign import ForeignBilliards, Played
from cuelearner_envs.billiards.table import CORNER_GAP, Table
from cuelearner_envs.pooltool import Outline
from cuelearner_jax.errors import UserError

# With it a free ball comes to rest after 1.3 m, as on our table, where it leaves with 0.5 m/s [m/s].
STRIKE_SPEED = 0.7


class Pooltool(NamedTuple):
    """Pooltool's physics on a table (`cuelearner_envs.billiards.foreign.Engine`)."""

    outline: Outline

    def __call__(self, positions: np.ndarray, pocketed: np.ndarray, angles: np.ndarray) -> Played:
        """Play shots one after another."""
        from cuelearner_envs.pooltool.game import play  # seconds to load: not where others play

        return play(self.outline, positions, pocketed, angles)


def make_environment(config: BilliardsConfig) -> ForeignBilliards:
    """The world that a configuration describes, in pooltool. Raises UserError if it can't be.

    Of the table's constants sizes alone count; friction, restitution and drag are pooltool's.
    """
    if find_spec("pooltool") is None:
        raise UserError("pooltool is not installed: pip install 'cuelearner-jax[pooltool]'")
    plain = make_billiards(config)
    if any(config.acceleration):
        raise UserError("pooltool's table is level: leave out --task.acceleration")
    return ForeignBilliards(**vars(plain), engine=Pooltool(outline_of(getattr(Table, config.table)())))


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
