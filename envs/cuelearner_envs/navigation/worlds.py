"""Generate worlds: a layout, and routes that the robot is proved to be able to walk.

Reachability is proved on a grid. A cell is passable if its middle keeps the body's reach and half a cell from every
solid. Then the straight line between the middles of two passable neighbours keeps the body's reach too, however the
body is turned, because distance changes no faster than place.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_envs.navigation.geometry import clearance, fixed_point
from cuelearner_envs.navigation.layouts import STYLES, Layout
from cuelearner_envs.navigation.robot import Robot
from cuelearner_envs.navigation.world import NavigationWorld

CELL = 0.2  # side of a grid cell [m]
CELLS = 100  # along either side: the largest world is 20 m
NEAREST, FARTHEST = 5.0, 15.0  # from start to goal [m]
JITTER = 0.1  # starts and goals lie this far from a cell's middle at most, along x and y [m]
ROUTES = 16
WORLDS_AT_ONCE = 64  # worlds generated together on an accelerator, which bounds the memory of their grids


def generate(key: PRNGKeyArray, style: str = "clutter") -> NavigationWorld:
    """Return a random world of a style (see `layouts`), whose every start reaches its goal, 5 to 15 m away."""

    def attempt(key: PRNGKeyArray) -> tuple[NavigationWorld, Bool[Array, ""]]:
        k_layout, k_routes = jax.random.split(key)
        return _with_routes(k_routes, STYLES[style](k_layout))

    def again(key: PRNGKeyArray) -> tuple[PRNGKeyArray, NavigationWorld, Bool[Array, ""]]:
        key, next_key = jax.random.split(key)
        return next_key, *attempt(key)

    _, world, _ = jax.lax.while_loop(lambda carry: ~carry[2], lambda carry: again(carry[0]), again(key))
    return world


@partial(jax.jit, static_argnames=("count", "style"))
def generate_many(key: PRNGKeyArray, count: int, style: str = "clutter") -> NavigationWorld:
    """`count` worlds (leading axis). World i does not depend on how many there are."""
    keys = jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(count))
    return jax.lax.map(partial(generate, style=style), keys, batch_size=together())


def together() -> int | None:
    """Return how many worlds are generated together; None on a CPU, where all would wait for the slowest."""
    return None if jax.default_backend() == "cpu" else WORLDS_AT_ONCE


def cell_centres() -> Float[Array, "cells cells 2"]:
    """Middles of the grid's cells [m]; the first axis runs along x."""
    along = (jnp.arange(CELLS) - (CELLS - 1) / 2) * CELL
    return jnp.stack(jnp.meshgrid(along, along, indexing="ij"), axis=-1)


def free_space(world: NavigationWorld) -> Float[Array, "cells cells"]:
    """Distance from each cell's middle to the nearest solid [m]; negative outside the walls."""
    centres = cell_centres()
    distance = jax.vmap(jax.vmap(lambda centre: clearance(world, centre)))(centres)
    return jnp.where((jnp.abs(centres) < world.extent[None, None] / 2).all(-1), distance, -1.0)


def flood(passable: Bool[Array, "cells cells"], seed: Bool[Array, "cells cells"]) -> Bool[Array, "cells cells"]:
    """The passable cells that can be reached from `seed` over the sides of cells."""

    def spread(reached: Bool[Array, "cells cells"]) -> Bool[Array, "cells cells"]:
        padded = jnp.pad(reached, 1)
        sides = padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
        return (reached | sides) & passable

    return fixed_point(lambda reached: spread(spread(reached)), seed & passable)


def any_of(key: PRNGKeyArray, usable: Bool[Array, " all"]) -> Int[Array, ""]:
    """Draw one of the usable cells; 0 where there are none.

    The draw of `jax.random.categorical` with equal weights, without its two logarithms a cell, which do not change the
    order of what they are taken of.
    """
    draws = jax.random.uniform(key, usable.shape, minval=jnp.finfo(jnp.float32).tiny)
    return jnp.argmax(jnp.where(usable, draws, -1.0))


def _with_routes(key: PRNGKeyArray, layout: Layout) -> tuple[NavigationWorld, Bool[Array, ""]]:
    """The world of a layout, and whether all its routes are as they should be."""
    nowhere = jnp.zeros((ROUTES, 2))
    world = NavigationWorld(*layout, starts=nowhere, goals=nowhere)
    distance = free_space(world)
    passable = distance >= Robot().reach + CELL / 2
    # Off its middle by `JITTER` a place still keeps the reach, and so does the line to the middle.
    roomy = distance >= Robot().reach + CELL / 2 + JITTER * 2**0.5
    k_seed, k_routes = jax.random.split(key)
    seed = any_of(k_seed, roomy.ravel())
    reached = flood(passable, jnp.zeros(roomy.size, bool).at[seed].set(True).reshape(roomy.shape))
    usable = (roomy & reached).ravel()
    # A world whose seed cell is cut off from the rest is rejected.
    connected = (passable & reached).sum() >= 0.8 * passable.sum()
    starts, goals, exists = jax.vmap(partial(_route, usable))(jax.random.split(k_routes, ROUTES))
    return world.replace(starts=starts, goals=goals), connected & exists.all()


def _route(usable: Bool[Array, " all"], key: PRNGKeyArray) -> tuple[jax.Array, jax.Array, Bool[Array, ""]]:
    """A random start and goal in usable cells at a distance in bounds, and whether there is one."""
    k_goal, k_start, k_jitter = jax.random.split(key, 3)
    centres = cell_centres().reshape(-1, 2)
    goal = any_of(k_goal, usable)
    distance = jnp.linalg.norm(centres - centres[goal][None], axis=-1)
    slack = 2 * JITTER * 2**0.5
    partners = usable & (distance >= NEAREST + slack) & (distance <= FARTHEST - slack)
    start = any_of(k_start, partners)
    jitter = jax.random.uniform(k_jitter, (2, 2), minval=-JITTER, maxval=JITTER)
    return centres[start] + jitter[0], centres[goal] + jitter[1], partners.any()
