"""Gymnasium's CartPole-v1 as an environment of JAX: keep a pole upright by pushing its cart left or right.

Constants and reward are those of Gymnasium 1.4: 10 N, steps of 0.02 s, ends at 2.4 m or 12 degrees; at most 500 steps,
each with reward 1. Source: Barto, Sutton, Anderson, "Neuronlike adaptive elements that can solve difficult learning
control problems" (1983).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import Choices
from cuelearner_jax.types import Step

GRAVITY, CART, POLE, HALF_LENGTH, FORCE, SECONDS = 9.8, 1.0, 0.1, 0.5, 10.0, 0.02


class CartState(struct.PyTreeNode):
    """Position [m], velocity [m/s], angle [rad], angular velocity [rad/s], and steps taken."""

    obs: jax.Array
    steps: jax.Array


class CartPole(WholeObservations, struct.PyTreeNode):
    """A pole on a cart; the first choice pushes left, the second right."""

    actions = Choices(2)
    observation = (
        Quantity("cart", 2, "m, m/s", "position, velocity"),
        Quantity("pole", 2, "rad, rad/s", "angle, angular velocity"),
    )

    def reset(self, key: jax.Array) -> tuple[CartState, jax.Array]:
        """Start with all four entries uniform in +-0.05."""
        obs = jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05)
        return CartState(obs, jnp.zeros((), jnp.int32)), obs

    def step(self, key: jax.Array, state: CartState, action: jax.Array) -> tuple[CartState, Step]:
        """Take one Euler step; the reward is 1."""
        _, speed, angle, turning = state.obs
        push = FORCE * (action[1] - action[0])
        total, sin, cos = CART + POLE, jnp.sin(angle), jnp.cos(angle)
        pushed = (push + POLE * HALF_LENGTH * turning**2 * sin) / total
        angular = (GRAVITY * sin - cos * pushed) / (HALF_LENGTH * (4.0 / 3.0 - POLE * cos**2 / total))
        linear = pushed - POLE * HALF_LENGTH * angular * cos / total
        final = state.obs + SECONDS * jnp.stack([speed, linear, turning, angular])
        terminated = (jnp.abs(final[0]) > 2.4) | (jnp.abs(final[2]) > jnp.deg2rad(12.0))
        truncated = (state.steps >= 499) & ~terminated
        fresh, _ = self.reset(key)
        after = CartState(final, state.steps + 1)
        after = jax.tree.map(lambda new, old: jnp.where(terminated | truncated, new, old), fresh, after)
        return after, Step(after.obs, final, final, jnp.ones(()), terminated, truncated, {}, {})
