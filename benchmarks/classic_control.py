"""Four of Gymnasium's classic control tasks as environments of JAX; `TASKS` has them by name.

Constants and rewards are those of Gymnasium 1.4. Sources: Barto, Sutton, Anderson, "Neuronlike adaptive elements that
can solve difficult learning control problems" (1983); Sutton, "Generalization in reinforcement learning" (1995);
Sutton, Barto, "Reinforcement learning" (1998), whose equations of the acrobot Gymnasium calls "book".
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import Box, Choices, Cue
from cuelearner_jax.types import Step

Transition = tuple[jax.Array, jax.Array, jax.Array]  # the next state (n,), its reward (), whether it is terminal ()


class Episode(struct.PyTreeNode):
    """The state (n,) of a task, in the units of its class, and the steps taken ()."""

    state: jax.Array
    steps: jax.Array


class Task(WholeObservations, struct.PyTreeNode):
    """A task whose subclass has `move`; an episode is truncated after `longest` steps.

    The state at its start is uniform within `spread` of `middle`.
    """

    longest = 500
    middle = spread = (0.0,)

    def move(self, state: jax.Array, action: jax.Array) -> Transition:
        """Take one step from a state (n,) by an action (entries,)."""
        raise NotImplementedError

    def observe(self, state: jax.Array) -> jax.Array:
        """Return the observation (obs,) of a state."""
        return state

    def reset(self, key: jax.Array) -> tuple[Episode, jax.Array]:
        """Start an episode."""
        middle = jnp.array(self.middle)
        state = middle + jnp.array(self.spread) * jax.random.uniform(key, middle.shape, minval=-1.0)
        return Episode(state, jnp.zeros((), jnp.int32)), self.observe(state)

    def step(self, key: jax.Array, state: Episode, action: jax.Array) -> tuple[Episode, Step]:
        """Take one step, and start the next episode if that was the end."""
        following, reward, terminated = self.move(state.state, action)
        after, final = Episode(following, state.steps + 1), self.observe(following)
        truncated = (after.steps >= self.longest) & ~terminated
        fresh, _ = self.reset(key)
        after = jax.tree.map(lambda new, old: jnp.where(terminated | truncated, new, old), fresh, after)
        return after, Step(self.observe(after.state), final, final, reward, terminated, truncated, {}, {})


class CartPole(Task):
    """Keep a pole upright by pushing its cart left or right with 10 N."""

    middle, spread = (0.0,) * 4, (0.05,) * 4
    actions = Choices(2)
    observation = (
        Quantity("cart", 2, "m, m/s", "position, velocity"),
        Quantity("pole", 2, "rad, rad/s", "angle, angular velocity"),
    )

    def move(self, state: jax.Array, action: jax.Array) -> Transition:
        """Take one Euler step of 0.02 s; the reward is 1. It ends at 2.4 m or 12 degrees."""
        gravity, cart, pole, half_length = 9.8, 1.0, 0.1, 0.5
        _, speed, angle, turning = state
        push = 10.0 * (action[1] - action[0])
        total, sin, cos = cart + pole, jnp.sin(angle), jnp.cos(angle)
        thrust = (push + pole * half_length * turning**2 * sin) / total
        angular = (gravity * sin - cos * thrust) / (half_length * (4.0 / 3.0 - pole * cos**2 / total))
        linear = thrust - pole * half_length * angular * cos / total
        after = state + 0.02 * jnp.stack([speed, linear, turning, angular])
        return after, jnp.ones(()), (jnp.abs(after[0]) > 2.4) | (jnp.abs(after[2]) > jnp.deg2rad(12.0))


class MountainCar(Task):
    """Leave a valley by swinging up its sides: an engine pushes left, not at all, or right."""

    longest = 200
    middle, spread = (-0.5, 0.0), (0.1, 0.0)
    actions = Choices(3)
    observation = (Quantity("car", 2, "1, 1/step", "position, velocity"),)

    def move(self, state: jax.Array, action: jax.Array) -> Transition:
        """Take one step; the reward is -1. It ends at 0.5."""
        position, speed = state
        pull = 0.001 * (action[2] - action[0]) - 0.0025 * jnp.cos(3 * position)
        speed = jnp.clip(speed + pull, -0.07, 0.07)
        position = jnp.clip(position + speed, -1.2, 0.6)
        speed = jnp.where((position <= -1.2) & (speed < 0), 0.0, speed)
        return jnp.stack([position, speed]), -jnp.ones(()), (position >= 0.5) & (speed >= 0)


class Acrobot(Task):
    """Swing the end of two links above a line by a torque of -1, 0 or 1 N m between them."""

    middle, spread = (0.0,) * 4, (0.1,) * 4
    actions = Choices(3)
    observation = (
        Quantity("links", 4, "1", "cosine and sine of the first angle from hanging, and of the second from the first"),
        Quantity("turning", 2, "rad/s", "their angular velocities"),
    )

    def observe(self, state: jax.Array) -> jax.Array:
        """Return the observation (6,) of both angles [rad] and their velocities [rad/s]."""
        first, second = state[0], state[1]
        return jnp.stack([jnp.cos(first), jnp.sin(first), jnp.cos(second), jnp.sin(second), state[2], state[3]])

    def move(self, state: jax.Array, action: jax.Array) -> Transition:
        """Take one Runge-Kutta step of 0.2 s; the reward is -1, and 0 for the step that ends it."""
        rate, seconds = lambda at: self._rate(at, action[2] - action[0]), 0.2
        k1 = rate(state)
        k2 = rate(state + seconds / 2 * k1)
        k3 = rate(state + seconds / 2 * k2)
        k4 = rate(state + seconds * k3)
        after = state + seconds / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        angles = jnp.mod(after[:2] + jnp.pi, 2 * jnp.pi) - jnp.pi
        fastest = jnp.pi * jnp.array([4.0, 9.0])
        is_up = -jnp.cos(angles[0]) - jnp.cos(angles[0] + angles[1]) > 1.0
        return jnp.concatenate([angles, jnp.clip(after[2:], -fastest, fastest)]), is_up - 1.0, is_up

    def _rate(self, state: jax.Array, torque: jax.Array) -> jax.Array:
        """Return the state's rate of change (4,): links of 1 kg, 1 m and 1 kg m^2, centres of mass halfway."""
        first, second, turning, bending = state
        cos, sin, gravity = jnp.cos(second), jnp.sin(second), 9.8
        inertia, coupling = 3.5 + cos, 1.25 + 0.5 * cos
        pull = 0.5 * gravity * jnp.sin(first + second)
        pulls = -0.5 * bending * (bending + 2 * turning) * sin + 1.5 * gravity * jnp.sin(first) + pull
        bend = torque + coupling / inertia * pulls - 0.5 * turning**2 * sin - pull
        bend = bend / (1.25 - coupling**2 / inertia)
        return jnp.stack([turning, bending, -(coupling * bend + pulls) / inertia, bend])


class Pendulum(Task):
    """Swing up a pole of 1 kg and 1 m by a torque of up to 2 N m, and hold it there."""

    longest = 200
    middle, spread = (0.0, 0.0), (jnp.pi, 1.0)
    observation = (
        Quantity("pole", 2, "1", "cosine and sine of its angle from upright"),
        Quantity("speed", 1, "rad/s", "angular velocity"),
    )
    actions = Box((-2.0,), (2.0,), (Cue("torque", ("left", "right"), ("ArrowLeft", "ArrowRight"), "shares"),))
    action = Quantity("torque", 1, "N m", "torque of the motor")

    def observe(self, state: jax.Array) -> jax.Array:
        """Return the observation (3,) of the angle from upright [rad] and its velocity [rad/s]."""
        return jnp.stack([jnp.cos(state[0]), jnp.sin(state[0]), state[1]])

    def move(self, state: jax.Array, action: jax.Array) -> Transition:
        """Take one Euler step of 0.05 s; the reward is the negative cost of the state before it and the torque."""
        angle, speed = state
        torque = jnp.clip(action[0], -2.0, 2.0)
        off = jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi
        cost = off**2 + 0.1 * speed**2 + 0.001 * torque**2
        speed = jnp.clip(speed + 0.05 * (15.0 * jnp.sin(angle) + 3.0 * torque), -8.0, 8.0)
        return jnp.stack([angle + 0.05 * speed, speed]), -cost, jnp.array(False)


TASKS = {"CartPole-v1": CartPole(), "MountainCar-v0": MountainCar(), "Acrobot-v1": Acrobot(), "Pendulum-v1": Pendulum()}
