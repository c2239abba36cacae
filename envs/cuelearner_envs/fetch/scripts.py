"""Scripted policies for FetchReach and FetchPush: memoryless functions of one observation.

An observation is flattened as `cl.from_gymnasium` does: achieved goal, desired goal, then Fetch's own vector.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Observations = Float[Array, "n obs"] | Float[np.ndarray, "n obs"]  # the command line gives NumPy's
Amount = float | Float[Array, ""]

GOAL, GRIPPER, OBJECT = slice(3, 6), slice(6, 9), slice(9, 12)
REACH_GAIN = 20.0  # gain on the distance to the goal, per metre; an action of 1 moves about 3 cm
GAIN = 20.0  # gain on the distances around the object
HIGH, LIFTED = 0.085, 0.055  # height above the object at which the gripper travels, and from which on it does [m]
LOW = 0.03  # below this height above the object's middle, the gripper can push [m]
BEYOND = 0.16  # behind the object's middle: the farthest start of a push [m]
CLEAR, ROUND = 0.05, 0.12  # distances from the object at which the gripper may travel while it rises [m]


class Gains(NamedTuple):
    """Parameters of `push`. Lengths in metres."""

    along: Amount = 8.0  # per metre of the way along the line to the goal
    side: Amount = 14.0  # per metre that the gripper is off that line
    back: Amount = 0.07  # where pushing begins, behind the object's middle
    ahead: Amount = 0.03  # behind the object's middle: nearest from where it pushes
    beside: Amount = 0.015  # off the line through object and goal: as far, it pushes
    arrived: Amount = 0.025  # from the place behind the object: as near, it goes down
    lead: Amount = 0.02  # added to the way that is left
    fastest: Amount = 0.1  # the most of it that counts
    pushed: Amount = 0.012  # from object to goal: as near, nothing is left to do


USUAL = Gains()


def reach(obs: Observations) -> Float[Array, "n 4"]:
    """Go straight to the goal."""
    obs = jnp.asarray(obs)
    return _action(REACH_GAIN * (obs[:, GOAL] - obs[:, GRIPPER]))


def push(obs: Observations, gains: Gains = USUAL) -> Float[Array, "n 4"]:
    """Rise, travel behind the object, go down, and push along the line from object to goal."""
    obs = jnp.asarray(obs)
    goal, gripper, thing = obs[:, GOAL], obs[:, GRIPPER], obs[:, OBJECT]
    way = goal[:, :2] - thing[:, :2]
    distance = jnp.linalg.norm(way, axis=-1, keepdims=True)
    ahead = way / jnp.maximum(distance, 1e-6)
    off = gripper[:, :2] - thing[:, :2]
    along = jnp.sum(off * ahead, -1, keepdims=True)
    side = off - along * ahead
    behind = thing[:, :2] - gains.back * ahead - gripper[:, :2]
    over = gripper[:, 2:] - thing[:, 2:]

    pushing = gains.along * ahead * jnp.minimum(distance + gains.lead, gains.fastest) - gains.side * side
    travelling = GAIN * behind
    down, up, level = -GAIN * over, jnp.ones_like(over), GAIN * (HIGH - over)
    away = jnp.linalg.norm(off, axis=-1, keepdims=True)

    in_place = (over < LOW) & (along < -gains.ahead) & (along > -BEYOND)
    in_place &= jnp.linalg.norm(side, axis=-1, keepdims=True) < gains.beside
    arrived = jnp.linalg.norm(behind, axis=-1, keepdims=True) < gains.arrived
    rises, free = over < LIFTED, (along < -CLEAR) | (away > ROUND)
    rising = jnp.where(free, travelling, 0.0)
    across = jnp.where(in_place, pushing, jnp.where(arrived | ~rises, travelling, rising))
    height = jnp.where(in_place | arrived, down, jnp.where(rises, up, level))
    return jnp.where(distance < gains.pushed, 0.0, _action(jnp.concatenate([across, height], -1)))


def _action(move: Float[Array, "n 3"]) -> Float[Array, "n 4"]:
    """Return a move that leaves the fingers unchanged."""
    return jnp.clip(jnp.concatenate([move, jnp.zeros_like(move[:, :1])], -1), -1.0, 1.0)


SCRIPTS = {"FetchReach-v4": reach, "FetchPush-v4": push}
