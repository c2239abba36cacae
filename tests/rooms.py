"""A room that pictures of navigation are looked at in."""

import math

import jax.numpy as jnp

from cuelearner_envs.navigation import World
from cuelearner_envs.navigation.world import FAR_AWAY


def room(starts, goals):
    """12 m by 8 m with a box in the middle of the upper half, turned by 30 degrees, and a column in the lower half."""
    walls = [[6.1, 0, 0, 0.1, 4.2], [-6.1, 0, 0, 0.1, 4.2], [0, 4.1, 0, 6.2, 0.1], [0, -4.1, 0, 6.2, 0.1]]
    boxes = [*walls, [0.0, 2.0, math.pi / 6, 0.9, 0.4], [FAR_AWAY, FAR_AWAY, 0.0, 0.01, 0.01]]
    return World(
        boxes=jnp.array(boxes),
        box_heights=jnp.array([1.5] * 4 + [0.8, 1.0]),
        circles=jnp.array([[2.0, -2.0, 0.5], [FAR_AWAY, FAR_AWAY, 0.01]]),
        circle_heights=jnp.array([1.4, 1.0]),
        extent=jnp.array([12.0, 8.0]),
        starts=jnp.array(starts, float),
        goals=jnp.array(goals, float),
    )
