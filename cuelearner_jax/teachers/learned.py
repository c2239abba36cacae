"""A learned teacher: the best direction by a network's values of what the environment's features show."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from flax import struct
from jaxtyping import Array, Float

from cuelearner_jax import actions as geometry
from cuelearner_jax.agents.networks import applied, q_network
from cuelearner_jax.agents.view import seen
from cuelearner_jax.config import LARGEST, MOST_LAYERS
from cuelearner_jax.errors import UserError
from cuelearner_jax.types import Params


@dataclass(frozen=True)
class TeacherConfig:
    """How the teacher is trained."""

    layers: tuple[int, ...] = (512, 512, 512, 512)
    """Hidden layers."""
    tables: int = 4096
    """Environments that play in parallel."""
    tries: int = 8
    """Directions tried in each state: the best, promising ones near their peaks, uniform ones."""
    search: int = 360
    """Directions over which it looks for promising ones (turned at random each time)."""
    directions: int = 3600
    """Directions among which the finished teacher takes its best."""
    memory: int = 64
    """Rounds of play kept for training."""
    updates: int = 8
    """Gradient steps a round."""
    batch_size: int = 8192
    """Tries in a gradient step."""
    learning_rate: float = 1e-3
    """Adam's peak step size (cosine decay over the run)."""
    rounds: int = 8000
    """Rounds of play."""
    explore_probability: float = 0.05
    """Share of shots played in a uniform direction."""
    spread_deg: float = 2.0
    """Largest standard deviation of the directions tried round a promising one [deg]."""


def check_config(config: TeacherConfig) -> None:
    """Raises UserError for values that cannot work."""
    for name in ("tables", "search", "directions", "memory", "updates", "batch_size", "rounds"):
        if not 1 <= getattr(config, name) <= LARGEST:
            raise UserError(f"teacher.{name} is {getattr(config, name)}: give a positive number of at most {LARGEST}")
    if config.rounds * config.updates > LARGEST:
        raise UserError(
            f"teacher.rounds times teacher.updates is {config.rounds * config.updates}: give at most {LARGEST}"
        )
    if not 4 <= config.tries <= LARGEST:
        raise UserError(
            f"teacher.tries is {config.tries}: give at least 4 (the best, a promising one, two uniform ones)"
        )
    if not 1 <= len(config.layers) <= MOST_LAYERS or min(config.layers) < 1 or max(config.layers) > LARGEST:
        raise UserError(f"teacher.layers: give at least one layer of positive width, at most {MOST_LAYERS}")
    if not 0 < config.learning_rate < math.inf:
        raise UserError(f"teacher.learning_rate is {config.learning_rate}: give a positive, finite number")
    if not 0 <= config.explore_probability <= 1:
        raise UserError(f"teacher.explore_probability is {config.explore_probability}: give a number from 0 to 1")
    if not 0 <= config.spread_deg <= 180:
        raise UserError(f"teacher.spread_deg is {config.spread_deg}: give a number from 0 to 180")


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
