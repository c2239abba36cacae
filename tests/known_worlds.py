"""Cheap worlds whose truth is known: a policy written by hand, and people who know what changed."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import DIRECTIONS, Box, Space
from cuelearner_jax.spaces.directions import retract, rotate

BEAMS, STEP_DEG = 36, 10.0
BOX = Box((-1.0, 0.0, 2.0), (1.0, 0.5, 4.0))


class Yard(WholeObservations, struct.PyTreeNode):
    """Two balls in metres, a goal's direction, and a ring of beams."""

    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)
    observation = (
        Quantity("ball", 2, "m"),
        Quantity("pocket", 2, "m"),
        Quantity("wind", 2, "1", "unit vector", "directions"),
        Quantity("lidar", BEAMS, "1", "nearness", "beams", STEP_DEG),
    )


def situations(key, policy, count):
    """Random ones."""
    return None, drawn(key, count)


@partial(jax.jit, static_argnums=1)
def drawn(key, count):
    """Observations of random situations."""
    k_place, k_wind, k_beams = jax.random.split(key, 3)
    places = jax.random.uniform(k_place, (count, 4), minval=-0.4, maxval=0.4)
    wind = retract(jax.random.normal(k_wind, (count, 2)))
    angle = jnp.arange(BEAMS) * (2 * jnp.pi / BEAMS)
    centre = jax.random.uniform(k_beams, (count, 1), maxval=2 * jnp.pi)
    beams = jnp.exp(2 * (jnp.cos(angle[None] - centre) - 1))
    return jnp.concatenate([places, wind, beams], -1)


@jax.jit
def aims(obs):
    """Toward a point between ball and pocket, blown aside by the wind, away from what is near: a direction."""
    ball, pocket, wind, beams = obs[:, :2], obs[:, 2:4], obs[:, 4:6], obs[:, 6:]
    angle = jnp.arange(BEAMS) * (2 * jnp.pi / BEAMS)
    near = jnp.stack([beams @ jnp.cos(angle), beams @ jnp.sin(angle)], -1) / BEAMS
    toward = retract(0.15 - ball) + 0.7 * retract(pocket + 0.1) + 0.4 * wind - 1.5 * near
    return retract(toward)


@jax.jit
def grips(obs):
    """Three numbers of a box."""
    ball, wind = obs[:, :2], obs[:, 4:6]
    shares = 0.5 + jnp.stack([0.5 * ball[:, 0], 0.4 * ball[:, 1], 0.2 * wind[:, 0] + 0.2 * ball[:, 0]], -1)
    low, high = jnp.array(BOX.low)[None], jnp.array(BOX.high)[None]
    return low + shares * (high - low)


def changed(obs, shift=(0.0, 0.0), lidar_deg=0.0, wind_deg=0.0):
    """Observations as they were before a change of the sensors, written without the package's own undoing."""
    obs = np.array(obs)
    obs[:, 0:4] -= np.tile(shift, 2)
    obs[:, 4:6] = np.asarray(rotate(jnp.asarray(obs[:, 4:6]), -jnp.deg2rad(wind_deg)))
    obs[:, 6:] = np.roll(obs[:, 6:], round(lidar_deg / STEP_DEG), axis=1)
    return jnp.asarray(obs)
