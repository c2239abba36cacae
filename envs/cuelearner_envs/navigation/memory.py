"""Where a robot has been: the places of its way so far, and what it remembers of them as a ring round the body.

A scan says nothing of the way that was tried, so a walker without memory goes back and forth behind a wall. With
`NavigationConfig.memory` the observation ends with `SEEN` numbers: in each of 36 directions, how much of the way so far
lies round the places a little and a good way off, in the body's frame.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from cuelearner_envs.navigation.world import FAR_AWAY
from cuelearner_jax.actions import from_angle, rotate, to_angle

PLACES = 50  # that are remembered; one more forgets the first
BETWEEN = 4  # steps from one to the next
SECTORS = 36
REACHES = (1.0, 2.5)  # how far off the places in a direction are that a sector asks about [m]
WIDTHS = (0.5, 1.0)  # within which a place on the way counts for them [m]
SEEN = len(REACHES) * SECTORS  # numbers in an observation
# Of the sectors, in the body's frame [rad]; of NumPy, so that no device is taken for a command that needs none.
MIDDLES = (np.arange(SECTORS, dtype=np.float32) + 0.5) * np.float32(2 * np.pi / SECTORS) - np.float32(np.pi)


def nothing() -> Float[Array, "places 2"]:
    """The way of somebody who has not set out."""
    return jnp.full((PLACES, 2), FAR_AWAY)


def longer(
    trail: Float[Array, "places 2"], steps: Int[Array, ""], place: Float[Array, "2"]
) -> Float[Array, "places 2"]:
    """The way with the place where step number `steps` (from 0) began, if it is one to remember."""
    added = trail.at[(steps // BETWEEN) % PLACES].set(place)
    return jnp.where(steps % BETWEEN == 0, added, trail)


def around(trail: Float[Array, "places 2"], pose: Float[Array, "3"]) -> Float[Array, " seen"]:
    """How much of a way lies round the places in each direction: 0 nothing, 0.6 passed once, toward 1.

    Returns:
        (SEEN,) the nearer places first, each from behind by way of the right, counterclockwise.
    """
    offsets = rotate(trail - pose[None, :2], -pose[2])
    found = []
    for reach, width in zip(REACHES, WIDTHS, strict=True):
        asked = reach * from_angle(jnp.asarray(MIDDLES))
        apart = jnp.sum(jnp.square(asked[:, None] - offsets[None]), -1)
        found.append(1.0 - jnp.exp(-jnp.exp(-apart / (2 * width**2)).sum(-1)))
    return jnp.concatenate(found)


def turned(seen: Float[Array, " seen"], directions: Float[Array, "*n 2"]) -> Float[Array, "*n seen"]:
    """The ring as it looks from directions: its middle, between sectors 17 and 18, is then the direction itself."""
    rings = seen.reshape(len(REACHES), SECTORS)
    first = to_angle(directions)[..., None] * (SECTORS / (2 * jnp.pi))
    shift = first + jnp.arange(SECTORS, dtype=jnp.float32).reshape((1,) * (first.ndim - 1) + (SECTORS,))
    first = jnp.floor(shift)
    before, after = (rings[:, jnp.mod(first.astype(jnp.int32) + step, SECTORS)] for step in (0, 1))
    mixed = before + (shift - first)[None] * (after - before)
    return jnp.moveaxis(mixed, 0, -2).reshape(*directions.shape[:-1], -1)


def mirrored(seen: Float[Array, " seen"]) -> Float[Array, " seen"]:
    """Left and right exchanged."""
    return jax.lax.rev(seen.reshape(len(REACHES), SECTORS), (1,)).ravel()
