"""A walled world of boxes and circles in padded arrays: the one description that is scanned, driven in and drawn.

Metres and radians; x to the right, y up, z from the floor; the origin is the world's centre. Left and right of an
obstacle are those of a robot on its way along x from its start to its goal: who passes it on the left keeps it on their
right.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

FAR_AWAY = 1000.0  # where unused rows lie [m]: a solid there is out of reach of everything
LOWEST, TALLEST = 0.6, 1.5  # heights of the solids drawn lightest and darkest [m]
OUTER = 4  # the first boxes of every world are its outer walls
BARRIER = 0.02  # half the thickness of what closes a side [m]


class NavigationWorld(struct.PyTreeNode):
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


def solids_of(world: NavigationWorld) -> list[tuple[np.ndarray, float]]:
    """Return boxes (5,) and circles (3,) with their heights, the lowest first: seen from above, the tall cover the low.

    Rows that only fill the arrays are left out.
    """
    rows = [*np.asarray(world.boxes, float), *np.asarray(world.circles, float)]
    heights = np.concatenate([world.box_heights, world.circle_heights]).tolist()
    solids = [(row, height) for row, height in zip(rows, heights, strict=True) if abs(row[0]) < FAR_AWAY / 2]
    return sorted(solids, key=lambda pair: pair[1])


def from_frame(pose: np.ndarray, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
    """Return points in the frame of a pose (x, y, yaw) as points of the world [m]."""
    x, y, yaw = np.asarray(pose, float)
    cos, sin = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[cos, sin], [-sin, cos]]) + [x, y]


def corners(box: np.ndarray) -> Float[np.ndarray, "4 2"]:
    """Return the corners of a box (x, y, yaw, half-length, half-width), in turn [m]."""
    return from_frame(box[:3], np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * box[3:])


def tallness(height: float) -> float:
    """Return 0 for the lowest solids up to 1 for the tallest, by which drawings shade them."""
    return float(np.clip((height - LOWEST) / (TALLEST - LOWEST), 0.0, 1.0))


def heading(start: Float[Array, "2"], goal: Float[Array, "2"]) -> Float[Array, ""]:
    """+1 for a way toward larger x, -1 for one toward smaller x."""
    return jnp.where(goal[0] >= start[0], 1.0, -1.0)


def obstacles(world: NavigationWorld) -> tuple[Float[Array, "obstacles 2"], Bool[Array, " obstacles"]]:
    """Middles of all solids but the outer walls [m], and which of them there are: unused ones lie far away."""
    middles = jnp.concatenate([world.boxes[OUTER:, :2], world.circles[:, :2]])
    return middles, (jnp.abs(middles) < world.extent[None] / 2).all(-1)


def count_passed(
    world: NavigationWorld, ahead: Float[Array, ""], before: Float[Array, "2"], after: Float[Array, "2"]
) -> Float[Array, "2"]:
    """Return how many obstacles a straight step passes, on the left and on the right.

    One is passed by a step that crosses the line through its middle across the corridor, forward (`ahead`, see
    `heading`); which side that is says where on this line.
    """
    middles, there = obstacles(world)
    x, step = middles[:, 0], after - before
    crosses = there & (ahead * (x - before[0]) > 0) & (ahead * (after[0] - x) >= 0)
    share = (x - before[0]) / jnp.where(step[0] == 0, 1.0, step[0])
    left = ahead * (before[1] + share * step[1] - middles[:, 1]) > 0
    return jnp.stack([jnp.sum(crosses & left), jnp.sum(crosses & ~left)]).astype(jnp.float32)


def closed(world: NavigationWorld, side: Float[Array, ""] | float) -> NavigationWorld:
    """The world with a thin barrier from each obstacle to the outer wall above it (side +1) or below it (-1)."""
    middles, there = obstacles(world)
    wall = side * world.extent[1] / 2
    x, y = middles[:, 0], middles[:, 1]
    zero, thin = jnp.zeros(len(middles)), jnp.full(len(middles), BARRIER)
    barrier = jnp.stack([x, (y + wall) / 2, zero, thin, jnp.abs(wall - y) / 2], axis=-1)
    barriers = jnp.where(there[:, None], barrier, jnp.array([FAR_AWAY, FAR_AWAY, 0.0, 0.01, 0.01])[None])
    heights = jnp.full(len(middles), world.box_heights[0])
    return world.replace(
        boxes=jnp.concatenate([world.boxes, barriers]), box_heights=jnp.concatenate([world.box_heights, heights])
    )
