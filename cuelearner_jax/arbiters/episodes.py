"""Arbiter by episodes: guide whole episodes, each with the same probability (paper: every second one)."""

from __future__ import annotations

from typing import Annotated, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.arbiters.protocol import Outcome
from cuelearner_jax.config import SHARE, Scalars, part


@part
class Config:
    """Options of the arbiter by episodes."""

    NAME: ClassVar[str] = "episodes"
    ABOUT: ClassVar[str] = "each episode is guided with the same probability"

    probability: Annotated[float, SHARE] = 0.5
    """Probability that an episode is guided."""

    def make(self, bootstraps: bool) -> Episodes:
        """Return the arbiter."""
        return Episodes()


class Episodes(NamedTuple):
    """The arbiter's functions (`protocol.Arbiter`); its state says whether the running episodes are guided."""

    def init(self, num_envs: int) -> Bool[Array, " num_envs"]:
        """Return the state of the start. First episodes begin with uniform actions and are the agent's own."""
        return jnp.zeros(num_envs, bool)

    def guided(self, state: Bool[Array, " num_envs"]) -> Bool[Array, " num_envs"]:
        """Return which running episodes are guided."""
        return state

    def follow(
        self, state: Bool[Array, " num_envs"], options: Config, scalars: Scalars, outcome: Outcome, key: PRNGKeyArray
    ) -> Bool[Array, " num_envs"]:
        """Draw whether to guide each episode that begins."""
        return redraw(key, state, outcome.done, options.probability)


def redraw(
    key: PRNGKeyArray,
    guided: Bool[Array, " num_envs"],
    done: Bool[Array, " num_envs"],
    probability: Float[Array, ""] | float,
) -> Bool[Array, " num_envs"]:
    """Return which episodes are guided, with a new draw where an episode is done."""
    return jnp.where(done, jax.random.bernoulli(key, probability, done.shape), guided)
