"""Billiards on pooltool's physics: cloth that balls slide and roll on, spin, cushions; a world that others wrote."""

from typing import NamedTuple


class Outline(NamedTuple):
    """A table and a strike, in plain numbers; as `billiards.Table` has them."""

    width: float  # [m]
    height: float  # [m]
    ball_radius: float  # [m]
    hole_width: float  # half the opening of a pocket [m]
    corner_gap: float  # between a corner and the cushions that end before it [m]
    cushion_radius: float  # [m]
    pocket_margin: float  # how far outside a ball's centre is pocketed [m]
    side_pockets: bool
    strike_speed: float  # of the cue ball, which leaves without spin [m/s]
