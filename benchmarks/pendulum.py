"""Gymnasium's Pendulum-v1 as an environment of JAX: swing up a pole by a torque, and hold it there.

Constants and reward are those of Gymnasium 1.4: gravity 10 m/s^2, 1 kg, 1 m, torques up to 2 N m, steps of 0.05 s, at
most 8 rad/s, episodes of 200 steps that time alone ends.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import Box, Cue
from cuelearner_jax.types import Step

GRAVITY, MASS, LENGTH, SECONDS, FASTEST, STRONGEST = 10.0, 1.0, 1.0, 0.05, 8.0, 2.0
STEPS = 200


class Swing(struct.PyTreeNode):
    """Angle from upright [rad], angular velocity [rad/s], and steps taken."""

    angle: jax.Array
    speed: jax.Array
    steps: jax.Array


class Pendulum(WholeObservations, struct.PyTreeNode):
    """A pole on a motor."""

    max_steps: jax.Array | int = STEPS

    observation = (
        Quantity("pole", 2, "1", "cosine and sine of its angle from upright"),
        Quantity("speed", 1, "rad/s", "angular velocity"),
    )
    actions = Box(
        (-STRONGEST,), (STRONGEST,), (Cue("torque", ("left", "right"), ("ArrowLeft", "ArrowRight"), "shares"),)
    )
    action = Quantity("torque", 1, "N m", "torque of the motor")

    def reset(self, key: jax.Array) -> tuple[Swing, jax.Array]:
        """Start at any angle, with up to 1 rad/s."""
        k_angle, k_speed = jax.random.split(key)
        angle = jax.random.uniform(k_angle, minval=-jnp.pi, maxval=jnp.pi)
        state = Swing(angle, jax.random.uniform(k_speed, minval=-1.0, maxval=1.0), jnp.zeros((), jnp.int32))
        return state, seen(state)

    def step(self, key: jax.Array, state: Swing, action: jax.Array) -> tuple[Swing, Step]:
        """Take one Euler step; the reward is the negative cost of the state before it and the torque."""
        torque = jnp.clip(action[0], -STRONGEST, STRONGEST)
        off = jnp.mod(state.angle + jnp.pi, 2 * jnp.pi) - jnp.pi
        cost = off**2 + 0.1 * state.speed**2 + 0.001 * torque**2
        pull = 3 * GRAVITY / (2 * LENGTH) * jnp.sin(state.angle) + 3.0 / (MASS * LENGTH**2) * torque
        speed = jnp.clip(state.speed + pull * SECONDS, -FASTEST, FASTEST)
        after = Swing(state.angle + speed * SECONDS, speed, state.steps + 1)
        truncated, final = after.steps >= self.max_steps, seen(after)
        following = jax.tree.map(lambda new, old: jnp.where(truncated, new, old), self.reset(key)[0], after)
        return following, Step(seen(following), final, final, -cost, jnp.array(False), truncated, {}, {})


def seen(state: Swing) -> jax.Array:
    """The observation (3,) of a state."""
    return jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle), state.speed])
