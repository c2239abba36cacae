"""Distances from points and straight lines to the solids of a world, seen from above. Closed form, one at a time.

And how far a disc walks among points, of whose solids nothing is known.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_envs.navigation.world import NavigationWorld
from cuelearner_jax.devices import goes_through


def fixed_point(function: Callable[[Array], Array], start: Array) -> Array:
    """Return what a function makes of an array when it is applied until nothing changes."""
    more = lambda carry: (carry[1], function(carry[1]))  # noqa: E731
    return jax.lax.while_loop(lambda carry: (carry[0] != carry[1]).any(), more, (start, function(start)))[1]


def in_frame(boxes: Float[Array, "boxes 5"], point: Float[Array, "2"]) -> Float[Array, "boxes 2"]:
    """A point in the frame of each box [m]."""
    offset = point[None] - boxes[:, :2]
    cos, sin = jnp.cos(boxes[:, 2]), jnp.sin(boxes[:, 2])
    return jnp.stack([cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]], axis=-1)


def clearance(world: NavigationWorld, point: Float[Array, "2"]) -> Float[Array, ""]:
    """Distance from a point to the nearest solid [m]; negative inside one."""
    beyond = jnp.abs(in_frame(world.boxes, point)) - world.boxes[:, 3:]
    to_boxes = jnp.sqrt(jnp.sum(jnp.square(jnp.maximum(beyond, 0.0)), -1)) + jnp.minimum(beyond.max(-1), 0.0)
    to_circles = jnp.sqrt(jnp.sum(jnp.square(point[None] - world.circles[:, :2]), -1)) - world.circles[:, 2]
    return jnp.minimum(to_boxes.min(), to_circles.min())


def line_clearance(world: NavigationWorld, start: Float[Array, "2"], end: Float[Array, "2"]) -> Float[Array, ""]:
    """Smallest distance between the line from `start` to `end` and any solid [m]; 0 where the line meets a box.

    A circle that the line enters gives a negative number: minus how deep.
    """
    to_circles = jax.vmap(lambda circle: _point_to_line(circle[:2], start, end) - circle[2])(world.circles)
    sizes = world.boxes[:, 3:]
    to_boxes = jax.vmap(_box_to_line)(sizes, in_frame(world.boxes, start), in_frame(world.boxes, end))
    return jnp.minimum(to_circles.min(), to_boxes.min())


def free_path(
    along: Float[Array, "*n points"], across: Float[Array, "*n points"], radius: float, most: float
) -> Float[Array, "*n"]:
    """Return how far a disc can go straight on before it touches one of the points [m], from 0 to `most`.

    Points lie `along` ahead of its middle, in the direction that it walks, and `across` aside [m].
    """
    chord = radius**2 - jnp.square(across)
    stop = along - jnp.sqrt(jnp.maximum(chord, 0.0))
    return jnp.clip(jnp.where((chord > 0) & (along > 0), stop, most).min(-1), 0.0, most)


def free_paths(
    directions: Float[Array, "*n 2"],
    places: Float[Array, "*n 2"],
    points: Float[Array, "points 2"],
    radius: float,
    most: float,
) -> Float[Array, "*n"]:
    """How far a disc can walk in directions from places, see `free_path` [m]."""
    (x, y), here = jnp.moveaxis(directions, -1, 0), jnp.sum(directions * places, -1)
    aside = x * places[..., 1] - y * places[..., 0]
    if not goes_through():
        x, y, here, aside = (part[..., None] for part in (x, y, here, aside))
        px, py = points[:, 0], points[:, 1]
        return free_path(x * px + y * py - here, x * py - y * px - aside, radius, most)

    def nearer(best: Float[Array, "*n"], point: Float[Array, "2"]) -> tuple[Float[Array, "*n"], None]:
        along, across = x * point[0] + y * point[1] - here, x * point[1] - y * point[0] - aside
        return jnp.minimum(best, free_path(along[..., None], across[..., None], radius, most)), None

    return jax.lax.scan(nearer, jnp.full(x.shape, most), points)[0]


def _point_to_line(point: Float[Array, "2"], start: Float[Array, "2"], end: Float[Array, "2"]) -> Float[Array, ""]:
    along, offset = end - start, point - start
    # Sums, not `vdot`: an accelerator rounds the factors of what it takes for a matrix product.
    share = jnp.clip(jnp.sum(offset * along) / jnp.maximum(jnp.sum(jnp.square(along)), 1e-12), 0.0, 1.0)
    return jnp.sqrt(jnp.sum(jnp.square(offset - share * along)))


def _box_to_line(half: Float[Array, "2"], start: Float[Array, "2"], end: Float[Array, "2"]) -> Float[Array, ""]:
    """Distance between a line and the box |x| <= half in the box's own frame.

    Where they are apart, the closest two points include a corner of the box or an end of the line.
    """
    signs = jnp.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    corners = jax.vmap(lambda sign: _point_to_line(sign * half, start, end))(signs).min()
    beyond = jnp.maximum(jnp.abs(jnp.stack([start, end])) - half[None], 0.0)
    ends = jnp.sqrt(jnp.sum(jnp.square(beyond), -1)).min()
    return jnp.where(_meets(half, start, end), 0.0, jnp.minimum(corners, ends))


def _meets(half: Float[Array, "2"], start: Float[Array, "2"], end: Float[Array, "2"]) -> Bool[Array, ""]:
    """Whether the line passes through the box, by separating axes: the box's two and the line's normal."""
    middle, reach = (start + end) / 2, (end - start) / 2
    apart = (jnp.abs(middle) > half + jnp.abs(reach)).any()
    cross = jnp.abs(middle[0] * reach[1] - middle[1] * reach[0])
    return ~apart & (cross <= half[0] * jnp.abs(reach[1]) + half[1] * jnp.abs(reach[0]))
