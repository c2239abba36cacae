"""Learn to walk: track velocity commands on uncertain ground, under noise and pushes (brax's `Env`).

The settings that make this learnable in minutes are those of a feasibility study on one accelerator: few but enough
iterations of the solver, targets that can reach the torque limit, rewards clipped at 0 from below.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax import envs
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.physics import AnymalGround, AnymalState, Felt, control, standing
from cuelearner_envs.anymal.policy import OBS, add_noise, observe
from cuelearner_jax.spaces.directions import from_angle

Scalar = float | Float[Array, ""]
TOUCHING = 0.003  # lower than this a foot is on the floor [m]


class Trial(struct.PyTreeNode):
    """Conditions of a trial. All fields are traced."""

    speed: Scalar = 1.0  # largest commanded [m/s], in any direction
    turning: Scalar = 1.0  # largest commanded turning rate [rad/s]
    rest: Scalar = 0.0  # share of commands to stand still
    noise: Scalar = 0.0  # of observations, as a share of `policy.NOISE`
    push: Scalar = 0.0  # largest change of velocity by a push [m/s], in any direction
    friction: tuple[Scalar, Scalar] = (robot.FRICTION, robot.FRICTION)  # lowest, highest
    payload: Scalar = 0.0  # most that is carried [kg]


# Beyond what is asked of the finished policy, so that this lies well inside.
TRAINING = Trial(speed=1.2, turning=1.6, rest=0.1, noise=1.0, push=0.7, friction=(0.4, 1.4), payload=8.0)
COMMAND_EVERY, PUSH_EVERY = 4.0, 5.0  # mean times between changes of the command, and between pushes [s]


class GaitState(struct.PyTreeNode):
    """`State.pipeline_state`: all that a robot carries between steps."""

    body: AnymalState
    last_action: Float[Array, "12"]
    command: Float[Array, "3"]  # velocity forward and to the left [m/s], turning rate [rad/s]
    ground: AnymalGround
    in_air: Float[Array, "4"]  # for how long each foot has been [s]


def random_command(key: PRNGKeyArray, trial: Trial) -> Float[Array, "3"]:
    """Draw a velocity in a uniform direction and a turning rate, both uniform up to the trial's; or standing still."""
    k_angle, k_speed, k_turn, k_rest = jax.random.split(key, 4)
    velocity = from_angle(jax.random.uniform(k_angle, (), minval=-jnp.pi, maxval=jnp.pi))
    velocity = velocity * jax.random.uniform(k_speed) * trial.speed
    turning = jax.random.uniform(k_turn, (1,), minval=-1.0, maxval=1.0) * trial.turning
    return jnp.concatenate([velocity, turning]) * (~jax.random.bernoulli(k_rest, trial.rest))


def random_ground(key: PRNGKeyArray, trial: Trial) -> AnymalGround:
    """Draw friction and payload, uniform within the trial's bounds."""
    k_friction, k_payload = jax.random.split(key)
    low, high = trial.friction
    friction = low + (high - low) * jax.random.uniform(k_friction)
    return AnymalGround(jnp.asarray(friction), jax.random.uniform(k_payload) * trial.payload)


def push_randomly(key: PRNGKeyArray, body: AnymalState, trial: Trial) -> AnymalState:
    """Apply a random push with some probability: the trunk's velocity changes at once."""
    k_when, k_angle, k_speed = jax.random.split(key, 3)
    now = jax.random.bernoulli(k_when, robot.CONTROL_PERIOD / PUSH_EVERY)
    change = from_angle(jax.random.uniform(k_angle, (), minval=-jnp.pi, maxval=jnp.pi))
    change = change * jax.random.uniform(k_speed) * trial.push * now
    return body.replace(qvel=body.qvel.at[:2].add(change))


def reward(
    before: GaitState, after: AnymalState, felt: Felt, action: Float[Array, "12"], landed: Float[Array, "4"]
) -> dict[str, Any]:
    """Return the terms of the reward of a step, already weighted; their sum counts where it is positive.

    `landed`: how long each foot that has just landed had been in the air [s], 0 for the others.
    """
    command = before.command
    velocity = robot.planar_velocity(after.qpos, after.qvel)
    error = jnp.sum(jnp.square(velocity[:2] - command[:2]))
    turn_error = jnp.square(velocity[2] - command[2])
    tilt = jnp.sum(jnp.square(robot.rotation(after.qpos[3:7])[2, :2]))
    bent = after.qpos[7:] - jnp.asarray(robot.HOME, jnp.float32)
    moving = jnp.linalg.norm(command) > 0.05
    return {
        "velocity": 1.0 * jnp.exp(-error / 0.25) + 0.7 * jnp.exp(-error / 0.02),
        "turning": 0.6 * jnp.exp(-turn_error / 0.25) + 0.2 * jnp.exp(-turn_error / 0.03),
        "bouncing": -2.0 * jnp.square(after.qvel[2]),
        "rocking": -0.05 * jnp.sum(jnp.square(after.qvel[3:5])),
        "tilt": -5.0 * tilt,
        "torque": -2e-5 * jnp.sum(jnp.square(felt.torques)),
        "jerk": -0.02 * jnp.sum(jnp.square(action - before.last_action)),
        "height": -10.0 * jnp.square(after.qpos[2] - robot.STANDING_HEIGHT),
        "posture": -0.05 * jnp.sum(jnp.square(bent)),
        "steps": 2.0 * jnp.sum(jnp.minimum(landed - 0.2, 0.2) * (landed > 0)) * moving,
        "fidgeting": -0.3 * jnp.sum(jnp.abs(bent)) * ~moving,
    }


class Locomotion(envs.Env):
    """Tracking of random velocity commands under a trial; 20 s an episode under brax's wrappers."""

    def __init__(self, trial: Trial = TRAINING):
        self.trial = trial

    @property
    def observation_size(self) -> int:
        """See `policy.observe`."""
        return OBS

    @property
    def action_size(self) -> int:
        """A target for each joint."""
        return robot.JOINTS

    @property
    def backend(self) -> str:
        """MuJoCo's."""
        return "mjx"

    def reset(self, rng: jax.Array) -> Any:
        """Stand at the origin with its joints a little off; ground and command are random."""
        k_body, k_yaw, k_command, k_ground, k_noise, k_next = jax.random.split(rng, 6)
        body = standing(jnp.zeros(2), jax.random.uniform(k_yaw, (), minval=-jnp.pi, maxval=jnp.pi))
        off = jax.random.uniform(k_body, (2, robot.JOINTS), minval=-1.0, maxval=1.0)
        body = body.replace(qpos=body.qpos.at[7:].add(0.1 * off[0]), qvel=body.qvel.at[6:].add(0.5 * off[1]))
        walk: Any = GaitState(
            body=body,
            last_action=jnp.zeros(robot.JOINTS),
            command=random_command(k_command, self.trial),
            ground=random_ground(k_ground, self.trial),
            in_air=jnp.zeros(4),
        )
        zero = jnp.zeros(())
        return envs.State(
            pipeline_state=walk,
            obs=add_noise(k_noise, observe(body.qpos, body.qvel, walk.last_action, walk.command), self.trial.noise),
            reward=zero,
            done=zero,
            metrics={"error": zero},
            info={"rng": k_next},
        )

    def step(self, state: Any, action: Float[Array, "12"]) -> Any:
        """A step of control, perhaps a push, perhaps a new command. A fall ends the episode."""
        before: GaitState = state.pipeline_state
        k_push, k_when, k_command, k_noise, k_next = jax.random.split(state.info["rng"], 5)
        body, felt = control(push_randomly(k_push, before.body, self.trial), action, before.ground)
        # A body whose numbers diverged counts as fallen; NaN must not reach the network.
        body = jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(body.qvel).all(), new, old), body, before.body)
        touching = felt.foot_heights < TOUCHING
        landed = jnp.where(touching, before.in_air, 0.0)  # for how long feet that have just landed were in the air [s]
        in_air = jnp.where(touching, 0.0, before.in_air + robot.CONTROL_PERIOD)
        terms = reward(before, body, felt, action, landed)
        total = jnp.maximum(sum(terms.values()), 0.0) * robot.CONTROL_PERIOD
        total = jnp.where(jnp.isfinite(total), total, 0.0)
        change = jax.random.bernoulli(k_when, robot.CONTROL_PERIOD / COMMAND_EVERY)
        command = jnp.where(change, random_command(k_command, self.trial), before.command)
        walk: Any = before.replace(body=body, last_action=action, command=command, in_air=in_air)
        error = jnp.linalg.norm(robot.planar_velocity(body.qpos, body.qvel)[:2] - before.command[:2])
        return state.replace(
            pipeline_state=walk,
            obs=add_noise(k_noise, observe(body.qpos, body.qvel, action, command), self.trial.noise),
            reward=total,
            done=felt.fallen.astype(jnp.float32),
            metrics={**state.metrics, "error": error},
            info={**state.info, "rng": k_next},
        )
