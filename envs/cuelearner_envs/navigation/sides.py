"""Count the side on which obstacles are passed, and make worlds with one side closed.

Left and right are those of a robot on its way along x from its start to its goal: who passes an obstacle on the left
keeps it on their right.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_envs.navigation.world import FAR_AWAY, World

OUTER = 4  # the first boxes of every world are its outer walls
BARRIER = 0.02  # half the thickness of what closes a side [m]


def heading(start: Float[Array, "2"], goal: Float[Array, "2"]) -> Float[Array, ""]:
    """+1 for a way toward larger x, -1 for one toward smaller x."""
    return jnp.where(goal[0] >= start[0], 1.0, -1.0)


def obstacles(world: World) -> tuple[Float[Array, "obstacles 2"], Bool[Array, " obstacles"]]:
    """Middles of all solids but the outer walls [m], and which of them there are: unused ones lie far away."""
    middles = jnp.concatenate([world.boxes[OUTER:, :2], world.circles[:, :2]])
    return middles, (jnp.abs(middles) < world.extent[None] / 2).all(-1)


def count_passed(
    world: World, ahead: Float[Array, ""], before: Float[Array, "2"], after: Float[Array, "2"]
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


def closed(world: World, side: Float[Array, ""] | float) -> World:
    """The world with a thin barrier from each obstacle to the outer wall above it (side +1) or below it (-1)."""
    middles, there = obstacles(world)
    wall = side * world.extent[1] / 2
    barrier = jnp.stack(
        [
            middles[:, 0],
            (middles[:, 1] + wall) / 2,
            jnp.zeros(len(middles)),
            jnp.full(len(middles), BARRIER),
            jnp.abs(wall - middles[:, 1]) / 2,
        ],
        axis=-1,
    )
    unused = jnp.array([FAR_AWAY, FAR_AWAY, 0.0, 0.01, 0.01])
    barriers = jnp.where(there[:, None], barrier, unused[None])
    heights = jnp.full(len(middles), world.box_heights[0])
    return world.replace(
        boxes=jnp.concatenate([world.boxes, barriers]), box_heights=jnp.concatenate([world.box_heights, heights])
    )
