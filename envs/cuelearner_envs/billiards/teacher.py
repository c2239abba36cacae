"""Billiards teachers: by search of all directions, near a network's proposals, or near what is done anyway."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_jax.spaces.directions import (
    best_direction,
    evenly_spaced,
    expected_values,
    nearest_direction,
    rotate,
    to_angle,
)

Scalar = Float[Array, ""] | float
PROPOSALS = 1200  # directions in which a network's values are taken
APART = 3  # of them, at least, between two that are looked at closely
REACH = math.radians(1.5)  # how far on either side shots are tried [rad]: a tilt of 0.005 m/s^2 bends a shot by less


class SearchTeacher(struct.PyTreeNode):
    """Tries every direction and prefers those that forgive an error of aim (`cuelearner_jax.types.Teacher`).

    Knows the table and its state exactly.
    """

    env: Billiards
    aim_error: Float[Array, ""] | float  # standard deviation of the error of a player's aim [rad]
    habit: Float[Array, ""] | float  # settles near-ties, see `actions.best_direction`
    directions: int = struct.field(pytree_node=False, default=1440)

    def rewards(self, state: Balls) -> Float[Array, " directions"]:
        """Reward of each of the directions."""
        key = jax.random.key(0)  # decides only where a fouled cue ball goes
        return jax.vmap(lambda action: self.env.step(key, state, action)[1].reward)(evenly_spaced(self.directions))

    def best_action(self, state: Balls, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """The direction with the largest expected reward. Looks at the true state, not at the observation."""
        return best_direction(self.rewards(state), self.aim_error, self.habit)

    def nearest_good(
        self, state: Balls, obs: Float[Array, " obs"], action: Float[Array, "2"], spread: Scalar, share: Scalar
    ) -> Float[Array, "2"]:
        """The nearest direction that it holds for good (`cuelearner_jax.types.ValuesDirections`)."""
        return nearest_direction(self.rewards(state), spread, share, action)


class Transferred(struct.PyTreeNode):
    """A teacher of one world in another with the same table, level or tilted alike (`cuelearner_jax.types.Teacher`).

    Sensor and strike may differ: it is shown the true state as its own sensor would show it, and what it would strike
    is turned so that the ball leaves the same way. Both are exact.
    """

    teacher: Any  # looks at the observation
    own: Billiards  # where it learned
    env: Billiards  # where it is asked

    def best_action(self, state: Balls, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """Return the action of the shot with the highest value; uses the true state, not the observation."""
        return self._here(self.teacher.best_action(state, self.own.observe(state)))

    def nearest_good(
        self, state: Balls, obs: Float[Array, " obs"], action: Float[Array, "2"], spread: Scalar, share: Scalar
    ) -> Float[Array, "2"]:
        """The nearest direction of a shot that the teacher holds for good."""
        struck = rotate(action, self.env.action_turn - self.own.action_turn)
        return self._here(self.teacher.nearest_good(state, self.own.observe(state), struck, spread, share))

    def _here(self, struck: Float[Array, "2"]) -> Float[Array, "2"]:
        """Convert a strike of the teacher's own world into the strike with the same shot in this world."""
        return rotate(struck, self.own.action_turn - self.env.action_turn)


class LocalSearchTeacher(struct.PyTreeNode):
    """Plays, in the world in which it is asked, what a learned teacher proposes (`cuelearner_jax.types.Teacher`).

    The network finds the few directions round which a shot may succeed; simulated shots decide. So it knows the true
    state, a turned strike and a slight tilt exactly; the network's errors count only where it proposes nothing good.
    """

    teacher: Any  # a network with `values(obs, options)`
    own: Billiards  # where it learned
    env: Billiards  # where it is asked
    aim_error: Float[Array, ""] | float  # standard deviation of the error of a player's aim [rad]
    habit: Float[Array, ""] | float  # settles near-ties, see `actions.best_direction`
    directions: int = struct.field(pytree_node=False, default=3600)
    peaks: int = struct.field(pytree_node=False, default=8)  # of the network's values that are looked at closely

    def best_action(self, state: Balls, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """The direction with the largest expected reward. Looks at the true state, not at the observation."""
        proposed = self.proposed(state)
        return best_direction(self.rewards(state, proposed, proposed[0]), self.aim_error, self.habit)

    def nearest_good(
        self, state: Balls, obs: Float[Array, " obs"], action: Float[Array, "2"], spread: Scalar, share: Scalar
    ) -> Float[Array, "2"]:
        """The nearest direction that it holds for good (`cuelearner_jax.types.ValuesDirections`).

        Shots near the action itself are tried too.
        """
        proposed = self.proposed(state)
        here = jnp.round(to_angle(action) * (self.directions / (2 * math.pi))).astype(jnp.int32)
        tried = self.rewards(state, jnp.append(proposed, here), proposed[0])
        return nearest_direction(tried, spread, share, action)

    def proposed(self, state: Balls) -> Int[Array, " peaks"]:
        """Numbers of the directions at the highest peaks of the network's values, the highest first."""
        turn = self.env.action_turn - self.own.action_turn  # what is struck here, and what there
        values = self.teacher.values(self.own.observe(state), rotate(evenly_spaced(PROPOSALS), turn))
        values = expected_values(values, self.aim_error)
        beside = jnp.stack([jnp.roll(values, number) for number in range(-APART, APART + 1)])
        summits = jnp.where(values >= beside.max(0), values, -jnp.inf)
        return jax.lax.top_k(summits, self.peaks)[1] * (self.directions // PROPOSALS)

    def rewards(
        self, state: Balls, centres: Int[Array, " centres"], otherwise: Int[Array, ""]
    ) -> Float[Array, " directions"]:
        """Reward of each direction near one of the centres, 0 elsewhere; where none succeeds, 1 at `otherwise`."""
        reach = round(REACH * self.directions / (2 * math.pi))
        near = (centres[:, None] + jnp.arange(-reach, reach + 1)[None]).ravel() % self.directions
        key = jax.random.key(0)  # decides only where a fouled cue ball goes
        shoot = lambda action: self.env.step(key, state, action)[1].reward  # noqa: E731
        values = jnp.zeros(self.directions).at[near].set(jax.vmap(shoot)(evenly_spaced(self.directions)[near]))
        return values.at[otherwise].add(jnp.where(values.max() > 0, 0.0, 1.0))
