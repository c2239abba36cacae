"""Scripted policies: memoryless functions of one observation.

Observations are Fetch's, flattened: these scripts act in Fetch too, and Fetch's (`cuelearner_envs.fetch.scripts`) here.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_envs.arm import model as arm
from cuelearner_envs.fetch import scripts as fetch
from cuelearner_envs.fetch.scripts import GOAL, GRIPPER, OBJECT, Amount, Gains, Observations

FINGERS = slice(15, 17)
CLEARANCE = 0.075  # from the post's axis: as far the cube's middle goes by [m]
STRETCH = 0.05  # how far along a tangent the script aims [m]
GAIN, CARRY_GAIN = 20.0, 12.0  # of a way, per metre: of the gripper alone, and with the cube
OVER = 0.09  # over the cube's middle: where the gripper travels [m]
LOW = -0.03  # over the cube's middle less the gripper's: above, fingers would sweep the cube aside [m]
ALIGNED = 0.012  # across: as near to the cube, the gripper goes down [m]
AROUND = 0.02  # from the cube's middle: as near, fingers close [m]
HELD = 0.028  # of each finger's opening: at most as wide, they hold the cube [m]
GRASPED = 0.035  # from the cube's middle: as near it stays while it is held [m]
PAST = Gains(
    along=6.0, side=24.0, back=0.055, ahead=0.015, beside=0.018, arrived=0.035, lead=0.005, fastest=0.06, pushed=0.025
)
# For a slippery cube, which slides on when the gripper stops, and leaves a gripper that is not behind it.
SLIPPERY, CAREFUL = 0.5, PAST._replace(along=5.5, side=20.0, beside=0.014, lead=0.0, pushed=0.015)
CARRIED = 0.35  # the largest entry of an action that carries a slippery cube


def past(obs: Observations, side: Amount = 0.0, friction: Amount = 1.0, post: Amount = 1.0) -> Float[Array, "n 4"]:
    """Push the cube past the post to the goal, on the shorter side or on a given one.

    `side`: +1 left, -1 right, as the robot sees the post; 0: the shorter. `friction`: of the cube, as far as it is
    known. `post`: 1 where it stands; 0: the cube is pushed straight.
    """
    obs = jnp.asarray(obs)
    cube, goal = obs[:, OBJECT], obs[:, GOAL]
    aim = jnp.where(post > 0, _aim(cube[:, :2], goal[:, :2], side), goal[:, :2])
    slips = jnp.asarray(friction) < SLIPPERY
    gains = Gains(*(jnp.where(slips, careful, usual) for careful, usual in zip(CAREFUL, PAST, strict=True)))
    return fetch.push(obs.at[:, GOAL].set(jnp.concatenate([aim, goal[:, 2:]], -1)), gains)


def _aim(cube: Float[Array, "n 2"], goal: Float[Array, "n 2"], side: Amount) -> Float[Array, "n 2"]:
    """Return the point to push the cube to next: the goal, or along the tangent to a circle around the post."""
    way, to_post = goal - cube, jnp.asarray(arm.POST_PLACE)[None] - cube
    ahead = way / jnp.maximum(jnp.linalg.norm(way, axis=-1, keepdims=True), 1e-6)
    along = jnp.sum(to_post * ahead, -1, keepdims=True)  # how far ahead the post is, and how far to the left
    beside = ahead[:, :1] * to_post[:, 1:] - ahead[:, 1:] * to_post[:, :1]
    which = jnp.where(side == 0, jnp.where(beside < 0, 1.0, -1.0), side)
    is_free = (along < 0) | (-which * beside >= CLEARANCE)
    far = jnp.maximum(jnp.linalg.norm(to_post, axis=-1, keepdims=True), 1e-6)
    sine = jnp.minimum(CLEARANCE / far, 1.0)
    cosine, sine = jnp.sqrt(1.0 - sine**2), which * sine
    x, y = to_post[:, :1] / far, to_post[:, 1:] / far
    tangent = jnp.concatenate([cosine * x - sine * y, sine * x + cosine * y], -1)
    return jnp.where(is_free, goal, cube + STRETCH * tangent)


def pick(obs: Observations, friction: Amount = 1.0) -> Float[Array, "n 4"]:
    """Travel over the cube with open fingers, go down, close, and carry the cube to the goal.

    `friction` is that of the cube, as far as it is known; a slippery one is carried slowly.
    """
    obs = jnp.asarray(obs)
    cube, goal, gripper = obs[:, OBJECT], obs[:, GOAL], obs[:, GRIPPER]
    off = cube - gripper
    across, down = off[:, :2], off[:, 2:]
    away = jnp.linalg.norm(across, axis=-1, keepdims=True)
    is_over = away < ALIGNED
    level = jnp.where(is_over, down, down + OVER)
    level = jnp.where((away > 4 * ALIGNED) & (down < -OVER), 0.0, level)  # travels at the height that it has
    coming = GAIN * jnp.concatenate([jnp.where((down > LOW) & ~is_over, 0.0, across), level], -1)
    is_between = is_over & (jnp.abs(down) < AROUND)
    opening = jnp.max(obs[:, FINGERS], -1, keepdims=True)
    is_held = (jnp.linalg.norm(off, axis=-1, keepdims=True) < GRASPED) & (opening < HELD)
    most = jnp.where(jnp.asarray(friction) < SLIPPERY, CARRIED, 1.0)
    carrying = jnp.clip(CARRY_GAIN * (goal - cube), -most, most)
    move = jnp.where(is_held, carrying, jnp.where(is_between, GAIN * off, coming))
    return jnp.clip(jnp.concatenate([move, jnp.where(is_held | is_between, -1.0, 1.0)], -1), -1.0, 1.0)


def act(
    skill: str, obs: Float[Array, "n obs"], side: Amount = 0.0, friction: Amount = 1.0, post: Amount = 1.0
) -> Float[Array, "n 4"]:
    """Return what the script of a skill does; `side`, `friction` and `post` as `past` has them."""
    if skill == "push":
        return past(obs, side, friction, post)
    return pick(obs, friction) if skill == "pick" else fetch.reach(obs)


reach, straight = fetch.reach, fetch.push  # Fetch's, which act here too
