"""A learned teacher: the best direction by a network's values of what the environment's features show."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents.networks import applied, q_network
from cuelearner_jax.agents.view import seen
from cuelearner_jax.spaces import directions as geometry
from cuelearner_jax.types import Params


def initial_params(layers: tuple[int, ...], env: Any, key: PRNGKeyArray) -> Params:
    """Fresh weights of a teacher's network."""
    return q_network(layers).init(key, *seen("action", env, jnp.zeros(env.obs_size), jnp.array([1.0, 0.0])))


def expected_reward(
    layers: tuple[int, ...], env: Any, params: Params, obs: Float[Array, " obs"], actions: Float[Array, "*n 2"]
) -> Float[Array, "*n"]:
    """A teacher's network: the reward that it expects of actions in one situation, as it looks from them."""
    return applied(q_network(layers))(params, *seen("action", env, obs, actions))[..., 0]


class LearnedTeacher(struct.PyTreeNode):
    """The best direction by a network's values (`cuelearner_jax.types.Teacher`). Looks at the observation alone."""

    env: Any  # gives the features
    params: Params
    aim_error: Float[Array, ""] | float  # standard deviation of the error of a player's aim [rad]
    habit: Float[Array, ""] | float  # settles near-ties, see `actions.best_direction`
    layers: tuple[int, ...] = struct.field(pytree_node=False)
    directions: int = struct.field(pytree_node=False)

    def values(self, obs: Float[Array, " obs"], options: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """Expected reward of each direction."""
        return expected_reward(self.layers, self.env, self.params, obs, options)

    def best_action(self, state: Any, obs: Float[Array, " obs"]) -> Float[Array, "2"]:
        """The direction with the largest value."""
        values = self.values(obs, geometry.evenly_spaced(self.directions))
        return geometry.best_direction(values, self.aim_error, self.habit)

    def nearest_good(
        self,
        state: Any,
        obs: Float[Array, " obs"],
        action: Float[Array, "2"],
        spread: Float[Array, ""] | float,
        share: Float[Array, ""] | float,
    ) -> Float[Array, "2"]:
        """The nearest direction that it holds for good (`cuelearner_jax.types.ValuesDirections`)."""
        values = self.values(obs, geometry.evenly_spaced(self.directions))
        return geometry.nearest_direction(values, spread, share, action)
