"""Inputs and outputs of shots in pooltool, in plain numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Outline(NamedTuple):
    """A table and a strike, in numbers; as `billiards.Table` has them."""

    width: float  # [m]
    height: float  # [m]
    ball_radius: float  # [m]
    hole_width: float  # half the opening of a pocket [m]
    corner_gap: float  # between a corner and the cushions that end before it [m]
    cushion_radius: float  # [m]
    pocket_margin: float  # how far outside a ball's centre is pocketed [m]
    side_pockets: bool
    strike_speed: float  # of the cue ball, which leaves without spin [m/s]


class Played(NamedTuple):
    """Outcomes of shots."""

    positions: np.ndarray  # (shots, balls, 2) at rest; of a pocketed ball without meaning [m]
    pocketed: np.ndarray  # (shots, balls) bool, those from before included
    duration: np.ndarray  # (shots,) [s]
    events: np.ndarray  # (shots,) int
    exhausted: np.ndarray  # (shots,) bool: halted after `game.MOST_EVENTS`
