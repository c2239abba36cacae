"""An auxiliary policy: a network of what to do, which acts in the agent's place in guided episodes.

Source: paper, section V-A ("an auxiliary policy that imitates the human teacher"); what it is taught differs by kind.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.actions import Actions
from cuelearner_jax.agent.networks import applied, residual_network
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guidance.refining import Refined
from cuelearner_jax.types import Params


class AuxiliaryPolicy(NamedTuple):
    """Functions of one policy's parameters."""

    sizes: GuideSizes
    obs_size: int
    space: Actions

    def init(self, key: PRNGKeyArray) -> Params:
        """Parameters that know nothing."""
        return self._network.init(key, jnp.zeros(self.obs_size), jnp.zeros(self.space.size))

    def vectors(
        self, env: Any, params: Params, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, "n action"]:
        """What it would do, short of being made actions; `actions` are those that it replaces."""
        return applied(self._network)(params, obs, jnp.zeros_like(actions))

    def act(
        self,
        env: Any,
        params: Params,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        """Its actions in place of those of active rows."""
        chosen = self.space.retract(self.vectors(env, params, obs, actions))
        return Refined(jnp.where(active[:, None], chosen, actions), active.astype(jnp.int32))

    @property
    def _network(self) -> Any:
        return residual_network(self.sizes.feedback_layers, self.space.size)


def auxiliary_policy(sizes: GuideSizes, spaces: Spaces) -> AuxiliaryPolicy:
    """A policy for an environment's spaces."""
    return AuxiliaryPolicy(sizes, spaces.obs_size, spaces.actions)
