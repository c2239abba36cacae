"""Worlds of navigation that are made by hand, and distances in any world by NumPy."""

import math

import jax.numpy as jnp
import numpy as np

from cuelearner_envs.navigation import NavigationWorld
from cuelearner_envs.navigation.world import FAR_AWAY

ORIGIN = ((0.0, 0.0),)


def world(
    boxes=(), circles=(), extent=(40.0, 40.0), starts=ORIGIN, goals=ORIGIN, heights=1.0, circle_heights=1.0, rows=(1, 1)
):
    """Boxes (x, y, yaw, half-length, half-width) and circles (x, y, radius), filled up to so many rows of each."""
    boxes = [*boxes, *[[FAR_AWAY, FAR_AWAY, 0.0, 0.01, 0.01]] * (rows[0] - len(boxes))]
    circles = [*circles, *[[FAR_AWAY, FAR_AWAY, 0.01]] * (rows[1] - len(circles))]
    return NavigationWorld(
        boxes=jnp.array(boxes, jnp.float32),
        box_heights=jnp.broadcast_to(jnp.array(heights), (len(boxes),)),
        circles=jnp.array(circles, jnp.float32),
        circle_heights=jnp.broadcast_to(jnp.array(circle_heights), (len(circles),)),
        extent=jnp.array(extent),
        starts=jnp.array(starts, float),
        goals=jnp.array(goals, float),
    )


def walls(width, height):
    """Four boxes around a hall, 0.2 m thick."""
    x, y = width / 2 + 0.1, height / 2 + 0.1
    return [[x, 0, 0, 0.1, y + 0.1], [-x, 0, 0, 0.1, y + 0.1], [0, y, 0, x + 0.1, 0.1], [0, -y, 0, x + 0.1, 0.1]]


def room(starts, goals):
    """12 m by 8 m with a box in the middle of the upper half, turned by 30 degrees, and a column in the lower half."""
    boxes, heights = [*walls(12.0, 8.0), [0.0, 2.0, math.pi / 6, 0.9, 0.4]], [1.5] * 4 + [0.8, 1.0]
    circles, tall = [[2.0, -2.0, 0.5]], [1.4, 1.0]
    return world(boxes, circles, (12.0, 8.0), starts, goals, heights, tall, rows=(6, 2))


def used(rows):
    return rows[np.abs(rows[:, 0]) < FAR_AWAY / 2]


def to_box(points, box):
    """Distance from points (..., 2) to a box; 0 inside."""
    cos, sin = math.cos(box[2]), math.sin(box[2])
    own = np.abs((points - box[:2]) @ np.array([[cos, -sin], [sin, cos]]))
    return np.linalg.norm(np.maximum(own - box[3:], 0.0), axis=-1)


def to_circle(points, circle):
    return np.maximum(np.linalg.norm(points - circle[:2], axis=-1) - circle[2], 0.0)


def to_segments(points, starts, ends):
    """Distances from points to segments (..., 2)."""
    along = ends - starts
    share = np.clip(np.sum((points - starts) * along, -1) / np.maximum(np.sum(along**2, -1), 1e-30), 0, 1)
    return np.linalg.norm(points - starts - share[..., None] * along, axis=-1)


def distance(points, boxes, circles):
    """From each point to the nearest solid; 0 inside one."""
    return np.min([to_box(points, box) for box in boxes] + [to_circle(points, circle) for circle in circles], axis=0)
