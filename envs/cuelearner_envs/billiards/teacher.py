"""Billiards teachers: by exhaustive search, and one that learned in one world asked in another."""

from __future__ import annotations

from typing import Any

import jax
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_jax.actions import best_direction, evenly_spaced, nearest_direction, rotate


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
        self,
        state: Balls,
        obs: Float[Array, " obs"],
        action: Float[Array, "2"],
        spread: Float[Array, ""] | float,
        share: Float[Array, ""] | float,
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
        """What leads to the shot that the teacher holds for best. Looks at the true state, not at the observation."""
        return self._here(self.teacher.best_action(state, self.own.observe(state)))

    def nearest_good(
        self,
        state: Balls,
        obs: Float[Array, " obs"],
        action: Float[Array, "2"],
        spread: Float[Array, ""] | float,
        share: Float[Array, ""] | float,
    ) -> Float[Array, "2"]:
        """The nearest direction of a shot that the teacher holds for good."""
        struck = rotate(action, self.env.action_turn - self.own.action_turn)
        return self._here(self.teacher.nearest_good(state, self.own.observe(state), struck, spread, share))

    def _here(self, struck: Float[Array, "2"]) -> Float[Array, "2"]:
        """What leads here to the shot that a strike leads to where the teacher learned."""
        return rotate(struck, self.own.action_turn - self.env.action_turn)
