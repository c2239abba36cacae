"""The action space as a bundle of functions, and its one instance: directions in the plane, as unit vectors.

Source: paper, section IV-A. Angles are radians, counterclockwise positive. Every function works on any leading axes.
Angles are wrapped with `atan2`, never with a modulo, so that the functions export to other runtimes unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

SQUARABLE = 1e15  # an entry up to this, and down to its inverse, has a square in single precision
ROUNDING = 1e-5  # of the largest of values that a Fourier transform averaged

Direction = Float[Array, "... 2"]
DirectionLike = Direction | Float[np.ndarray, "... 2"]  # what functions take; they give JAX's arrays
Angle = Float[Array, "..."] | Float[np.ndarray, "..."] | float


class Actions(NamedTuple):
    """An action space. Every function works on any leading axes; actions have `size` entries on the last one."""

    size: int
    uniform: Callable[[PRNGKeyArray, tuple[int, ...]], Array]  # (key, shape) -> random actions (*shape, size)
    spread: Callable[[int], Array]  # count -> actions (count, size), evenly spaced
    retract: Callable[[Array], Array]  # any vector -> the nearest action
    clip: Callable[[Array, Array, Angle], Array]  # (action, base, radius) -> the nearest action within it of base
    distance: Callable[[Array, Array], Array]  # (action, other) -> how far apart they are
    sense: Callable[[Array, Array], Array]  # (action, goal) -> h: -1, 0 or +1, the way from one to the other
    toward: Callable[[Array, Array, Angle], Array]  # (action, h, step) -> the action moved by a step the way of h
    outward: Callable[[Array, Array], Array]  # (vector as it looks from an action, action) -> the vector


def from_angle(angle: Angle) -> Direction:
    """Unit vector that points along `angle` [rad]."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def to_angle(action: DirectionLike) -> Float[Array, "..."]:
    """Angle of a direction in (-pi, pi] [rad]."""
    return jnp.arctan2(action[..., 1], action[..., 0])


def rotate(action: DirectionLike, angle: Angle) -> Direction:
    """`action` turned counterclockwise by `angle` [rad]."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = action[..., 0], action[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def difference(start: DirectionLike, end: DirectionLike) -> Float[Array, "..."]:
    """Signed angle from `start` to `end` in (-pi, pi] [rad]; positive: counterclockwise."""
    cross = start[..., 0] * end[..., 1] - start[..., 1] * end[..., 0]
    dot = start[..., 0] * end[..., 0] + start[..., 1] * end[..., 1]
    return jnp.arctan2(cross, dot)


def retract(vector: DirectionLike) -> Direction:
    """The direction nearest to a vector (the vector divided by its length), however long or short the vector is.

    The zero vector gives the x axis, which networks need; a vector that is not finite gives NaN, which shows.
    """
    largest = jnp.max(jnp.abs(vector), axis=-1, keepdims=True)
    # By powers of two, and by 1.0 as a rule: no bit of a usual vector changes.
    small = jnp.where(largest < 1 / SQUARABLE, 2.0**80, 1.0)
    vector = vector * jnp.where(largest > SQUARABLE, 2.0**-80, small).astype(vector.dtype)
    length = jnp.linalg.norm(vector, axis=-1, keepdims=True)
    length = jnp.where(jnp.isfinite(length), length, jnp.nan)
    return jnp.where(length == 0, jnp.array([1.0, 0.0], vector.dtype), vector / jnp.where(length == 0, 1.0, length))


def only_actions(vector: DirectionLike) -> Direction:
    """Vectors as they are, but NaN in place of each that is no action: one that is not finite, or zero.

    What comes from a user's code passes through here, so that a fault of that code shows and does not act.
    """
    usable = jnp.isfinite(vector).all(-1, keepdims=True) & (vector != 0).any(-1, keepdims=True)
    return jnp.where(usable, vector, jnp.nan)


def clip_to_ball(action: DirectionLike, base: DirectionLike, radius: Angle) -> Direction:
    """The direction within `radius` [rad] of `base` that lies nearest to `action` (paper, Eq. 5).

    On the unit circle the L2 ball of radius r round `base` is the arc of half-width 2 asin(r / 2), so the bound is an
    angle. A radius of pi or more leaves every action as it is.
    """
    turn = difference(base, action)
    inside = jnp.abs(turn) <= radius
    return jnp.where(inside[..., None], action, rotate(base, jnp.clip(turn, -radius, radius)))


def distance(action: DirectionLike, other: DirectionLike) -> Float[Array, "..."]:
    """Angle between two directions, in [0, pi] [rad]."""
    return jnp.abs(difference(action, other))


def sense(action: DirectionLike, goal: DirectionLike) -> Float[Array, "..."]:
    """h: +1 if `goal` lies counterclockwise of `action`, -1 if clockwise, 0 if it is the same."""
    return jnp.sign(difference(action, goal))


def toward(action: DirectionLike, h: Float[Array, "..."], step: Angle) -> Direction:
    """`action` turned by h * step [rad]."""
    return rotate(action, h * step)


def outward(vector: Float[Array, "... 2"], action: DirectionLike) -> Float[Array, "... 2"]:
    """A vector given along and across (counterclockwise) a direction, in the frame in which the direction is given."""
    along, across = vector[..., 0], vector[..., 1]
    x, y = action[..., 0], action[..., 1]
    return jnp.stack([x * along - y * across, y * along + x * across], axis=-1)


def inward(vector: Float[Array, "... 2"], action: DirectionLike) -> Float[Array, "... 2"]:
    """The inverse of `outward`: how much of a vector lies along a direction, and how much across it."""
    return outward(vector, jnp.stack([action[..., 0], -action[..., 1]], axis=-1))


def evenly_spaced(count: int) -> Float[Array, "count 2"]:
    """`count` directions, the first along x, the others counterclockwise."""
    return from_angle(jnp.arange(count) * (2 * math.pi / count))


def uniform(key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Direction:
    """Directions drawn uniformly (paper, Eq. 6): shape (*shape, 2)."""
    return from_angle(jax.random.uniform(key, shape, minval=-math.pi, maxval=math.pi))


DIRECTIONS = Actions(
    size=2,
    uniform=uniform,
    spread=evenly_spaced,
    retract=retract,
    clip=clip_to_ball,
    distance=distance,
    sense=sense,
    toward=toward,
    outward=outward,
)


def best_direction(
    values: Float[Array, " count"], spread: Float[Array, ""] | float, habit: Float[Array, ""] | float
) -> Float[Array, "2"]:
    """The best of `evenly_spaced(count)` for a player with an imperfect aim and a habit.

    Args:
        values: value of each direction, not negative where it matters.
        spread: standard deviation of the aim [rad]. Values are averaged over it, so a wide window of good directions
            beats a narrow one and its middle beats its edge. 0: perfect aim.
        habit: share by which values shrink over a full turn counterclockwise from x. It settles near-ties (a symmetric
            table has many) always the same way; without it the choice jumps between far-apart directions from state to
            state and can't be learned from. 0: no habit.
    """
    count, expected = values.shape[0], expected_values(values, spread)
    return evenly_spaced(count)[jnp.argmax(expected * (1.0 - habit * _turns(count) / (2 * math.pi)))]


def nearest_direction(
    values: Float[Array, " count"],
    spread: Float[Array, ""] | float,
    share: Float[Array, ""] | float,
    action: Float[Array, "2"],
) -> Float[Array, "2"]:
    """The direction nearest to an action among those of `evenly_spaced(count)` that a player holds for good.

    Good is what is expected to be worth at least a share of the best. Where nothing is worth anything (the best is not
    above 0), the best alone is.

    Args:
        values: value of each direction.
        spread: standard deviation of the aim [rad], over which values are averaged; 0: perfect aim.
        share: of the best expected value.
        action: from which it is looked for.
    """
    expected = expected_values(values, spread)
    best = jnp.argmax(expected)
    worth_it = expected >= (share - ROUNDING) * expected[best]
    good = jnp.where(expected[best] > 0, worth_it, jnp.arange(values.shape[0]) == best)
    options = evenly_spaced(values.shape[0])
    return options[jnp.argmin(jnp.where(good, distance(options, action), jnp.inf))]


def expected_values(values: Float[Array, " count"], spread: Float[Array, ""] | float) -> Float[Array, " count"]:
    """Values of evenly spaced directions, averaged over a normal error of aim of standard deviation `spread` [rad]."""
    turn = _turns(values.shape[0])
    around = jnp.minimum(turn, 2 * math.pi - turn)
    kernel = jax.nn.softmax(-0.5 * jnp.square(around / jnp.maximum(spread, 1e-6)))
    return jnp.fft.irfft(jnp.fft.rfft(values) * jnp.fft.rfft(kernel), n=values.shape[0])


def _turns(count: int) -> Float[Array, " count"]:
    """How far each of `evenly_spaced(count)` is turned from x, counterclockwise [rad]."""
    return jnp.arange(count) * (2 * math.pi / count)
