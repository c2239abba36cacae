"""The guide's action is executed where a critic that did not choose values it above the agent's.

Imitation bootstrapped reinforcement learning takes whichever of two actions has the larger Q (Hu, Mirchandani, Sadigh,
RSS 2024). An agent that takes the argmax of Q never finds another action larger by the same Q. So a second critic
compares: it starts from other parameters, learns from other batches of the same replay, and selects nothing, so that
what the first overestimates is not the second's error too (double Q-learning: van Hasselt, NeurIPS 2010).
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.arbiters.episodes import redrawn
from cuelearner_jax.arbiters.protocol import Known, Outcome
from cuelearner_jax.config import SHARE, Scalars, part
from cuelearner_jax.guides.refining import Refined
from cuelearner_jax.types import Params


@part
class Config:
    """Options of comparing values."""

    NAME: ClassVar[str] = "by_value"
    ABOUT: ClassVar[str] = "the guide's action is executed where a second critic values it above the agent's"

    probability: Annotated[float, SHARE] = 1.0
    """Probability that an episode is arbitrated; others are the agent's own."""

    def make(self, bootstraps: bool) -> ByValue:
        """The arbiter."""
        return ByValue()


class Compared(struct.PyTreeNode):
    """The episodes that are arbitrated, and the second critic."""

    arbitrated: Bool[Array, " num_envs"]
    params: Params = None
    training: Any = None  # what learning keeps beside the parameters


class ByValue(NamedTuple):
    """The arbiter's functions (`protocol.Chooses`, `protocol.HasCritic`)."""

    def init(self, num_envs: int) -> Compared:
        """The first episodes, which begin with uniform actions, are the agent's own; there is no critic yet."""
        return Compared(jnp.zeros(num_envs, bool))

    def guided(self, state: Compared) -> Bool[Array, " num_envs"]:
        """The episodes that are arbitrated."""
        return state.arbitrated

    def follow(
        self, state: Compared, options: Config, scalars: Scalars, outcome: Outcome, key: PRNGKeyArray
    ) -> Compared:
        """Draws for the episodes that begin."""
        return state.replace(arbitrated=redrawn(key, state.arbitrated, outcome.done, options.probability))

    def critic(self, state: Compared) -> tuple[Params, Any]:
        """The second critic."""
        return state.params, state.training

    def with_critic(self, state: Compared, critic: tuple[Params, Any]) -> Compared:
        """The state with another second critic."""
        return state.replace(params=critic[0], training=critic[1])

    def choose(
        self,
        state: Compared,
        options: Config,
        known: Known,
        obs: Float[Array, "num_envs obs"],
        base: Float[Array, "num_envs action"],
        learns: Bool[Array, ""],
        key: PRNGKeyArray,
    ) -> Refined:
        """The guide's action where the second critic values it above the agent's, in arbitrated episodes."""
        asked = state.arbitrated & learns
        guided = known.guide.act(known.model, known.env, obs, base, asked, known.scalars)

        def gain(obs: Array, own: Array, other: Array) -> Array:
            values = known.agent.value(known.env, state.params, obs, jnp.stack([own, other]))
            return values[1] - values[0]

        better = asked & (jax.vmap(gain)(obs, base, guided.actions) > 0)
        return Refined(jnp.where(better[:, None], guided.actions, base), jnp.where(better, guided.passes, 0))
