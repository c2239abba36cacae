"""Lay out the solids of each style of world. A layout may be impassable; `worlds` then draws another."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_envs.navigation.world import FAR_AWAY

WALL = 0.1  # half the thickness of an outer wall [m]
WALL_HEIGHT = 1.5  # [m]
LOWEST, HIGHEST = 0.8, 1.4  # heights of obstacles [m]: the lidar, at about half a metre, sees all of them


class Layout(NamedTuple):
    """Solids of one world."""

    boxes: Float[Array, "boxes 5"]
    box_heights: Float[Array, " boxes"]
    circles: Float[Array, "circles 3"]
    circle_heights: Float[Array, " circles"]
    extent: Float[Array, "2"]


def clutter(key: PRNGKeyArray) -> Layout:
    """A square hall of 20 m with 8 to 16 boxes and 6 to 12 circles at random places: the training worlds."""
    extent = jnp.array([20.0, 20.0])
    k_count, k_place, k_turn, k_size, k_round, k_radius, k_tall = jax.random.split(key, 7)
    k_boxes, k_circles = jax.random.split(k_count)
    exists = jnp.arange(16) < jax.random.randint(k_boxes, (), 8, 17)
    boxes = _draw(16, (k_place, 2, -9.5, 9.5), (k_turn, 1, 0.0, math.pi), (k_size, 2, 0.2, 0.9))
    exists_round = jnp.arange(12) < jax.random.randint(k_circles, (), 6, 13)
    circles = _draw(12, (k_round, 2, -9.5, 9.5), (k_radius, 1, 0.15, 0.6))
    return _layout(k_tall, extent, _only(exists, boxes), _only(exists_round, circles))


def rooms(key: PRNGKeyArray) -> Layout:
    """An office of 18 m by 14 m: two rows of three rooms, doorways of 1.3 to 1.7 m, a narrow passage, thin obstacles.

    The middle room of each row is a passage about 1.5 to 1.9 m wide, left or right of the office's middle.
    """
    extent = jnp.array([18.0, 14.0])
    k_walls, k_doors, k_thin, k_poles, k_tall = jax.random.split(key, 5)
    k_middle, k_left, k_narrow, k_side = jax.random.split(k_walls, 4)
    middle = jax.random.uniform(k_middle, (), minval=-1.5, maxval=1.5)  # the wall between the two rows
    left = jax.random.uniform(k_left, (), minval=-4.5, maxval=-0.5)
    narrow = jax.random.uniform(k_narrow, (), minval=1.5, maxval=1.9) + 0.12
    columns = jnp.stack([left, left + narrow])
    columns = jnp.where(jax.random.bernoulli(k_side), columns, -columns[::-1])
    # From edge to edge of each room's wall: three stretches along x, two along y on each of two columns.
    xs = jnp.concatenate([-extent[:1] / 2, columns, extent[:1] / 2])
    ys = jnp.stack([-extent[1] / 2, middle, extent[1] / 2])
    along_x = jnp.stack([xs[:-1], jnp.full(3, middle), xs[1:], jnp.full(3, middle)], -1)
    along_y = jnp.stack([jnp.repeat(columns, 2), jnp.tile(ys[:-1], 2), jnp.repeat(columns, 2), jnp.tile(ys[1:], 2)], -1)
    stretches = jnp.concatenate([along_x, along_y])
    walls = jax.vmap(_wall_with_door)(jax.random.split(k_doors, stretches.shape[0]), stretches).reshape(-1, 5)
    k_place, k_turn, k_length, k_width = jax.random.split(k_thin, 4)
    inside = -extent / 2 + 0.8, extent / 2 - 0.8
    shape = (k_turn, 1, 0.0, math.pi), (k_length, 1, 0.3, 0.8), (k_width, 1, 0.02, 0.05)
    thin = _draw(6, (k_place, 2, *inside), *shape)
    k_where, k_radius = jax.random.split(k_poles)
    poles = _draw(8, (k_where, 2, *inside), (k_radius, 1, 0.05, 0.12))
    return _layout(k_tall, extent, jnp.concatenate([walls, thin]), poles)


def corridor(key: PRNGKeyArray) -> Layout:
    """A corridor of 20 m by 4.6 m with four obstacles near its middle line: each can be passed on either side."""
    extent = jnp.array([20.0, 4.6])
    k_along, k_across, k_turn, k_size, k_kind, k_tall = jax.random.split(key, 6)
    along = jnp.linspace(-6.6, 6.6, 4) + jax.random.uniform(k_along, (4,), minval=-0.7, maxval=0.7)
    across = jax.random.uniform(k_across, (4,), minval=-0.15, maxval=0.15)
    size = jax.random.uniform(k_size, (4, 2), minval=0.25, maxval=0.45)
    turn = jax.random.uniform(k_turn, (4,), maxval=math.pi)
    is_round = jax.random.bernoulli(k_kind, 0.5, (4,))
    boxes = jnp.concatenate([along[:, None], across[:, None], turn[:, None], size], axis=-1)
    circles = jnp.stack([along, across, size[:, 0] + 0.1], axis=-1)
    return _layout(k_tall, extent, _only(~is_round, boxes), _only(is_round, circles))


STYLES: dict[str, Callable[[PRNGKeyArray], Layout]] = {"clutter": clutter, "rooms": rooms, "corridor": corridor}
BOXES, CIRCLES = 24, 12  # rows of every world: the largest layout's, with its four outer walls


def _wall_with_door(key: PRNGKeyArray, ends: Float[Array, "4"]) -> Float[Array, "2 5"]:
    """A thin wall from (x, y) to (x, y) as two pieces with a doorway somewhere between; short walls are all doorway."""
    k_width, k_place, k_thick = jax.random.split(key, 3)
    start, end = ends[:2], ends[2:]
    length = jnp.linalg.norm(end - start)
    width = jax.random.uniform(k_width, (), minval=1.3, maxval=1.7)
    thickness = jax.random.uniform(k_thick, (), minval=0.04, maxval=0.08)
    room = jnp.maximum(length - width, 0.0)
    before = room * jax.random.uniform(k_place, (), minval=0.2, maxval=0.8)
    pieces = jnp.stack([before, room - before])
    direction = (end - start) / length
    centres = jnp.stack([start + direction * pieces[0] / 2, end - direction * pieces[1] / 2])
    yaw = jnp.arctan2(direction[1], direction[0])
    shape = jnp.stack([pieces / 2, jnp.full(2, thickness)], -1)
    return _only(pieces > 0.2, jnp.concatenate([centres, jnp.full((2, 1), yaw), shape], axis=-1))


def _draw(count: int, *columns: tuple[PRNGKeyArray, int, Any, Any]) -> Float[Array, "count width"]:
    """Rows of uniform numbers: of each group of columns the key, their number, and both bounds."""
    groups = [jax.random.uniform(key, (count, width), minval=low, maxval=high) for key, width, low, high in columns]
    return jnp.concatenate(groups, axis=-1)


def _only(exists: Bool[Array, " rows"], rows: Float[Array, "rows width"]) -> Float[Array, "rows width"]:
    """The rows in use; the others far away and tiny."""
    return jnp.where(exists[:, None], rows, _unused(*rows.shape))


def _unused(count: int, width: int) -> Float[Array, "count width"]:
    """Rows of tiny solids far away."""
    row = jnp.array([FAR_AWAY, FAR_AWAY, 0.0, 0.01, 0.01] if width == 5 else [FAR_AWAY, FAR_AWAY, 0.01])
    return jnp.broadcast_to(row, (count, width))


def _layout(
    key: PRNGKeyArray, extent: Float[Array, "2"], boxes: Float[Array, "some 5"], circles: Float[Array, "few 3"]
) -> Layout:
    """Obstacles with outer walls, filled up to the common size."""
    half = extent / 2
    walls = jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    centres = walls * (half + WALL)[None]
    shape = jnp.where(jnp.abs(walls) > 0, WALL, half[None] + 2 * WALL)
    outer = jnp.concatenate([centres, jnp.zeros((4, 1)), shape], axis=-1)
    boxes = jnp.concatenate([outer, boxes, _unused(BOXES - 4 - boxes.shape[0], 5)])
    circles = jnp.concatenate([circles, _unused(CIRCLES - circles.shape[0], 3)])
    k_boxes, k_circles = jax.random.split(key)
    heights = jax.random.uniform(k_boxes, (BOXES,), minval=LOWEST, maxval=HIGHEST).at[:4].set(WALL_HEIGHT)
    circle_heights = jax.random.uniform(k_circles, (CIRCLES,), minval=LOWEST, maxval=HIGHEST)
    return Layout(boxes, heights, circles, circle_heights, extent)
