"""A walled world of boxes and circles in padded arrays: the one description that is scanned, driven in and drawn.

Metres and radians; x to the right, y up, z from the floor; the origin is the world's centre.
"""

from __future__ import annotations

from flax import struct
from jaxtyping import Array, Float

FAR_AWAY = 1000.0  # where unused rows lie [m]: a solid there is out of reach of everything


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
