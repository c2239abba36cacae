"""A walled world of boxes and circles in padded arrays: the one description that is scanned, driven in and drawn.

Metres and radians; x to the right, y up, z from the floor; the origin is the world's centre.
"""

from __future__ import annotations

import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Float

FAR_AWAY = 1000.0  # where unused rows lie [m]: a solid there is out of reach of everything
LOWEST, TALLEST = 0.6, 1.5  # heights of the solids drawn lightest and darkest [m]


class World(struct.PyTreeNode):
    """A world. The arrays of all worlds have equal sizes, whatever the style, so that worlds can be stacked.

    Unused rows hold a tiny solid `FAR_AWAY`. Solids stand on the floor and may overlap; the outer walls are boxes too.
    """

    boxes: Float[Array, "boxes 5"]  # x, y, yaw, half-length, half-width [m, rad]
    box_heights: Float[Array, " boxes"]  # [m]
    circles: Float[Array, "circles 3"]  # x, y, radius [m]
    circle_heights: Float[Array, " circles"]  # [m]
    extent: Float[Array, "2"]  # length along x and y between the outer walls [m]
    starts: Float[Array, "routes 2"]  # where episodes may begin [m]; from each the robot can reach the goal of its row
    goals: Float[Array, "routes 2"]  # [m], 5 to 15 m from the start as the crow flies


def used(rows: ArrayLike, heights: ArrayLike) -> list[tuple[np.ndarray, float]]:
    """Return boxes or circles with their heights, without those that only fill the arrays."""
    pairs = zip(np.asarray(rows, float), np.asarray(heights, float).tolist(), strict=True)
    return [(row, height) for row, height in pairs if abs(row[0]) < FAR_AWAY / 2]


def tallness(height: float) -> float:
    """Return 0 for the lowest solids up to 1 for the tallest, by which drawings shade them."""
    return float(np.clip((height - LOWEST) / (TALLEST - LOWEST), 0.0, 1.0))
