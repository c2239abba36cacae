"""The billiards teacher by exhaustive search: tries every direction and prefers those that forgive an error of aim."""

from __future__ import annotations

import jax
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_jax.actions import best_direction, evenly_spaced


class SearchTeacher(struct.PyTreeNode):
    """Knows the table and its state exactly (`cuelearner_jax.types.Teacher`)."""

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
