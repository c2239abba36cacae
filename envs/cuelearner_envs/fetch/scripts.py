"""Policies for FetchReach and FetchPush, written by hand: they look at one observation and remember nothing.

An observation is flattened as `cl.from_gymnasium` does: achieved goal, desired goal, then Fetch's own vector.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

GOAL, GRIPPER, OBJECT = slice(3, 6), slice(6, 9), slice(9, 12)
REACH_GAIN = 20.0  # of the way to the goal, per metre; an action of 1 is a step of some 3 cm
GAIN = 20.0  # the same of the ways round the object
ALONG_GAIN, SIDE_GAIN = 8.0, 14.0  # while it pushes: along the line to the goal, and back to that line
BACK = 0.07  # where pushing begins, behind the object's middle [m]
HIGH, LIFTED = 0.085, 0.055  # over the object: where the gripper travels, and from where on it does [m]
LOW = 0.03  # over the object's middle: below, the gripper can push [m]
AHEAD, BEYOND = 0.03, 0.16  # behind the object's middle: nearest and farthest from where it pushes [m]
BESIDE = 0.015  # off the line through object and goal: as far, it pushes [m]
ARRIVED = 0.025  # from the place behind the object: as near, it goes down [m]
CLEAR, ROUND = 0.05, 0.12  # behind the object, or from it: as far, it may travel while it rises [m]
PUSHED = 0.012  # from object to goal: as near, nothing is left to do [m]
LEAD, FASTEST = 0.02, 0.1  # added to the way that is left, and the most of it that counts [m]

Script = Callable[[Float[Array, "n obs"]], Float[Array, "n 4"]]


def reach(obs: Float[Array, "n obs"]) -> Float[Array, "n 4"]:
    """Go straight to the goal."""
    return _action(REACH_GAIN * (obs[:, GOAL] - obs[:, GRIPPER]))


def push(obs: Float[Array, "n obs"]) -> Float[Array, "n 4"]:
    """Rise, travel behind the object, go down, and push along the line from object to goal."""
    goal, gripper, thing = obs[:, GOAL], obs[:, GRIPPER], obs[:, OBJECT]
    way = goal[:, :2] - thing[:, :2]
    left = jnp.linalg.norm(way, axis=-1, keepdims=True)
    ahead = way / jnp.maximum(left, 1e-6)
    off = gripper[:, :2] - thing[:, :2]
    along = jnp.sum(off * ahead, -1, keepdims=True)
    side = off - along * ahead
    behind = thing[:, :2] - BACK * ahead - gripper[:, :2]
    over = gripper[:, 2:] - thing[:, 2:]

    pushing = ALONG_GAIN * ahead * jnp.minimum(left + LEAD, FASTEST) - SIDE_GAIN * side
    travelling = GAIN * behind
    down, up, level = -GAIN * over, jnp.ones_like(over), GAIN * (HIGH - over)
    away = jnp.linalg.norm(off, axis=-1, keepdims=True)

    in_place = (over < LOW) & (along < -AHEAD) & (along > -BEYOND)
    in_place &= jnp.linalg.norm(side, axis=-1, keepdims=True) < BESIDE
    arrived = jnp.linalg.norm(behind, axis=-1, keepdims=True) < ARRIVED
    rises, free = over < LIFTED, (along < -CLEAR) | (away > ROUND)
    rising = jnp.where(free, travelling, 0.0)
    across = jnp.where(in_place, pushing, jnp.where(arrived | ~rises, travelling, rising))
    height = jnp.where(in_place | arrived, down, jnp.where(rises, up, level))
    return jnp.where(left < PUSHED, 0.0, _action(jnp.concatenate([across, height], -1)))


def _action(move: Float[Array, "n 3"]) -> Float[Array, "n 4"]:
    """A move with the fingers as they are."""
    return jnp.clip(jnp.concatenate([move, jnp.zeros_like(move[:, :1])], -1), -1.0, 1.0)


SCRIPTS: dict[str, Script] = {"FetchReach-v4": reach, "FetchPush-v4": push}
