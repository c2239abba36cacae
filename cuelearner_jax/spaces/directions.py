"""Directions in the plane, as unit vectors: the space of the paper's tasks, and their geometry.

Source: paper, section IV-A. Angles are radians, counterclockwise positive. Every function works on any leading axes.
Angles are wrapped with `atan2`, never with a modulo, so that the functions export to other runtimes unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.spaces.space import Cue, Space

SQUARABLE = 1e15  # entries between this and its inverse have squares within single precision
ROUNDING = 1e-5  # rounding error of a Fourier transform, as a share of the largest value

Direction = Float[Array, "... 2"]
DirectionLike = Direction | Float[np.ndarray, "... 2"]  # accepted arrays; results are JAX's arrays
Angle = Float[Array, "..."] | Float[np.ndarray, "..."] | float


def from_angle(angle: Angle) -> Direction:
    """Return the unit vector that points along `angle` [rad]."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def to_angle(action: DirectionLike) -> Float[Array, "..."]:
    """Return the angle of a direction in (-pi, pi] [rad]."""
    return jnp.arctan2(action[..., 1], action[..., 0])


def rotate(action: DirectionLike, angle: Angle) -> Direction:
    """Return `action` turned counterclockwise by `angle` [rad]."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = action[..., 0], action[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def difference(start: DirectionLike, end: DirectionLike) -> Float[Array, "..."]:
    """Return the signed angle from `start` to `end` in (-pi, pi] [rad], counterclockwise positive."""
    cross = start[..., 0] * end[..., 1] - start[..., 1] * end[..., 0]
    dot = start[..., 0] * end[..., 0] + start[..., 1] * end[..., 1]
    return jnp.arctan2(cross, dot)


def retract(vector: DirectionLike) -> Direction:
    """Return the direction nearest to a vector of any length: the vector divided by its length.

    The zero vector gives the x axis, as networks need a direction; a vector that is not finite gives NaN.
    """
    largest = jnp.max(jnp.abs(vector), axis=-1, keepdims=True)
    # Scaling by powers of two, mostly 1.0, changes no bit of a usual vector.
    small = jnp.where(largest < 1 / SQUARABLE, 2.0**80, 1.0)
    vector = vector * jnp.where(largest > SQUARABLE, 2.0**-80, small).astype(vector.dtype)
    length = jnp.linalg.norm(vector, axis=-1, keepdims=True)
    length = jnp.where(jnp.isfinite(length), length, jnp.nan)
    return jnp.where(length == 0, jnp.array([1.0, 0.0], vector.dtype), vector / jnp.where(length == 0, 1.0, length))


def outward(vector: DirectionLike, action: DirectionLike) -> Float[Array, "... 2"]:
    """Return a vector, given along and across (counterclockwise) a direction, in the frame of the direction."""
    along, across = vector[..., 0], vector[..., 1]
    x, y = action[..., 0], action[..., 1]
    return jnp.stack([x * along - y * across, y * along + x * across], axis=-1)


def inward(vector: Float[Array, "... 2"], action: DirectionLike) -> Float[Array, "... 2"]:
    """Return how much of a vector lies along a direction, and how much across it: the inverse of `outward`."""
    return outward(vector, jnp.stack([action[..., 0], -action[..., 1]], axis=-1))


def evenly_spaced(count: int) -> Float[Array, "count 2"]:
    """Return `count` directions, the first along x, the others counterclockwise."""
    return from_angle(jnp.arange(count) * (2 * math.pi / count))


def uniform(key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Direction:
    """Draw directions uniformly (paper, Eq. 6): shape (*shape, 2)."""
    return from_angle(jax.random.uniform(key, shape, minval=-math.pi, maxval=math.pi))


@dataclass(frozen=True)
class Directions(Space):
    """Unit vectors in the plane. Their one cue is the turn: radians inside, degrees in options and files."""

    name = "directions"
    about = "unit vectors"
    size = 2
    cues = (Cue("turn", ("counterclockwise", "clockwise"), ("ArrowLeft", "ArrowRight"), "degrees"),)
    reach = 180.0
    sample: ClassVar[Any] = staticmethod(uniform)
    spread: ClassVar[Any] = staticmethod(evenly_spaced)
    retract: ClassVar[Any] = staticmethod(retract)
    outward: ClassVar[Any] = staticmethod(outward)

    def words_of(self, action: Any) -> str:
        """Return the angle of a direction."""
        return f"{math.degrees(math.atan2(float(action[1]), float(action[0]))):.0f} degrees"

    def log(self, action: DirectionLike, other: DirectionLike) -> Float[Array, "... 1"]:
        """Return the angle from one direction to another, in (-pi, pi] [rad]."""
        return difference(action, other)[..., None]

    def exp(self, action: DirectionLike, change: Float[Array, "... 1"]) -> Direction:
        """Turn a direction counterclockwise [rad]."""
        return rotate(action, jnp.asarray(change)[..., 0])

    def from_unit(self, amount: Any) -> Float[Array, "..."]:
        """Convert degrees to radians."""
        return jnp.deg2rad(jnp.asarray(amount, jnp.float32))

    def to_unit(self, change: Any, xp: Any = jnp) -> Any:
        """Convert radians to degrees."""
        return xp.rad2deg(change)

    def usable(self, vector: Any, xp: Any = jnp) -> Any:
        """Return which vectors have a direction: those that are finite and not zero."""
        return super().usable(vector, xp) & (vector != 0).any(-1)


DIRECTIONS = Directions()


def best_direction(
    values: Float[Array, " count"], spread: Float[Array, ""] | float, habit: Float[Array, ""] | float
) -> Float[Array, "2"]:
    """Return the best of `evenly_spaced(count)` for a player with an imperfect aim and a habit.

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
    """Return the good direction nearest to an action, among `evenly_spaced(count)`.

    A direction is good if its expected value is at least a share of the best one's. Where the best value is not above
    0, only the best direction is good.

    Args:
        values: value of each direction.
        spread: standard deviation of the aim [rad], over which values are averaged; 0: perfect aim.
        share: least share of the best expected value.
        action: the action from which the nearest one is searched.
    """
    expected = expected_values(values, spread)
    best = jnp.argmax(expected)
    worth_it = expected >= (share - ROUNDING) * expected[best]
    good = jnp.where(expected[best] > 0, worth_it, jnp.arange(values.shape[0]) == best)
    options = evenly_spaced(values.shape[0])
    return options[jnp.argmin(jnp.where(good, DIRECTIONS.distance(options, action), jnp.inf))]


def expected_values(values: Float[Array, " count"], spread: Float[Array, ""] | float) -> Float[Array, " count"]:
    """Return the values of evenly spaced directions, averaged over a normal error of aim.

    `spread`: standard deviation of the error [rad].
    """
    turn = _turns(values.shape[0])
    kernel = jax.nn.softmax(-0.5 * jnp.square(jnp.minimum(turn, 2 * math.pi - turn) / jnp.maximum(spread, 1e-6)))
    return jnp.fft.irfft(jnp.fft.rfft(values) * jnp.fft.rfft(kernel), n=values.shape[0])


def _turns(count: int) -> Float[Array, " count"]:
    """Return the angle of each of `evenly_spaced(count)` from x, counterclockwise [rad]."""
    return jnp.arange(count) * (2 * math.pi / count)
