"""The quadruped's physics in MJX: one control step, from a minimal state."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

import contextlib
import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from cuelearner_envs.anymal import model as robot

with contextlib.redirect_stdout(None):  # silences a note on an optional engine that is not installed
    from mujoco import mjx

Scalar = float | Float[Array, ""]
LOWEST_TRUNK, LOWEST_KNEE = 0.3, 0.05  # below these heights the robot counts as fallen [m]
LEAST_UPRIGHT = 0.5  # cosine of the tilt beyond which it has fallen


class AnymalState(struct.PyTreeNode):
    """The state between control steps; `mjx.Data` (kilobytes) is rebuilt from it each step."""

    qpos: Float[Array, "19"]  # see `model`
    qvel: Float[Array, "18"]
    warmstart: Float[Array, "18"]  # the solver's first guess: the last accelerations [m/s^2, rad/s^2]


class AnymalGround(struct.PyTreeNode):
    """Conditions that may differ between robots."""

    friction: Scalar = robot.FRICTION  # of feet on the floor
    payload: Scalar = 0.0  # carried at the trunk's centre of mass [kg]


class Felt(struct.PyTreeNode):
    """Measurements of a control step, beside the body's new state."""

    foot_heights: Float[Array, "4"]  # of the feet's lowest points above the floor [m]
    torques: Float[Array, "12"]  # of the drives, at the step's end [Nm]
    fallen: Bool[Array, ""]


@functools.cache
def compiled() -> tuple[Any, Any, Any]:
    """Return MJX's model, an empty `mjx.Data`, and the indices of the bodies read, even if called while tracing."""
    model = robot.load()
    with jax.ensure_compile_time_eval():
        places = {
            "feet": jnp.array([model.geom(f"{leg}_FOOT").id for leg in robot.LEGS]),
            "shanks": jnp.array([model.body(f"{leg}_SHANK").id for leg in robot.LEGS]),
            "trunk": model.body("trunk").id,
        }
        return mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax"), places


def standing(place: Float[Array, "2"], yaw: Scalar) -> AnymalState:
    """Return the robot at rest on straight feet at a position [m], turned by `yaw` [rad]."""
    half = jnp.asarray(yaw) / 2
    quaternion = jnp.stack([jnp.cos(half), jnp.zeros(()), jnp.zeros(()), jnp.sin(half)])
    height = jnp.full(1, robot.STANDING_HEIGHT)
    qpos = jnp.concatenate([place, height, quaternion, jnp.asarray(robot.HOME, jnp.float32)])
    return AnymalState(qpos, jnp.zeros(18), jnp.zeros(18))


def control(body: AnymalState, action: Float[Array, "12"], ground: AnymalGround) -> tuple[AnymalState, Felt]:
    """Return the body after a control step (0.02 s) with an action in [-1, 1]: joint targets relative to home."""
    model, data, places = compiled()
    trunk, feet = places["trunk"], places["feet"]
    model = model.replace(
        geom_friction=model.geom_friction.at[feet, 0].set(ground.friction),
        body_mass=model.body_mass.at[trunk].add(ground.payload),
    )
    targets = jnp.asarray(robot.HOME) + jnp.asarray(robot.ACTION_SCALE) * action

    def one(carry: AnymalState, _: None) -> tuple[AnymalState, tuple[jax.Array, ...]]:
        begun = data.replace(qpos=carry.qpos, qvel=carry.qvel, qacc_warmstart=carry.warmstart, ctrl=targets)
        with jax.default_matmul_precision("highest"):  # an accelerator would round the factors to three digits
            after = mjx.step(model, begun)
        heights = after.geom_xpos[feet, 2], after.xpos[places["shanks"], 2], after.actuator_force
        return AnymalState(after.qpos, after.qvel, after.qacc_warmstart), heights

    steps = round(robot.CONTROL_PERIOD / float(robot.load().opt.timestep))
    body, states = jax.lax.scan(one, body, length=steps)
    foot, knee, torques = (leaf[-1] for leaf in states)
    return body, Felt(foot - robot.FOOT_RADIUS, torques, fallen(body, knee))


def fallen(body: AnymalState, knees: Float[Array, "4"]) -> Bool[Array, ""]:
    """Whether the robot lies or touches the floor with more than its feet; true for diverged numbers too."""
    upright = robot.rotation(body.qpos[3:7])[2, 2]
    stands = (upright > LEAST_UPRIGHT) & (body.qpos[2] > LOWEST_TRUNK) & (knees > LOWEST_KNEE).all()
    return ~(stands & jnp.isfinite(body.qvel).all())
