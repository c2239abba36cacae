"""An arbiter of one's own in one file: the agent begins each episode, the guide takes over late in some of them.

The guide then acts where the agent's own actions have led. Run in the folder above this one, with any task whose
episodes are long enough:

    cuelearner sweep examples.reach:TASK --arbiter examples.late_arbiter:Config --arbiter.after 5 --out runs/late
"""

from __future__ import annotations

from typing import Annotated, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from cuelearner_jax.arbiters import Arbiter, Outcome, redraw
from cuelearner_jax.config import SHARE, Bounds, Scalars, part


class Running(NamedTuple):
    """State of the running episodes."""

    chosen: Bool[Array, " num_envs"]  # whether the guide takes over
    steps: Int[Array, " num_envs"]  # since the episode began


@part
class Config(Arbiter):
    """A late guide. The probability is traced; another `after` compiles again."""

    NAME: ClassVar[str] = "late"
    ABOUT: ClassVar[str] = "the guide takes over episodes that the agent has begun"

    after: Annotated[int, Bounds(0)] = 5
    """Steps at the beginning of an episode that are always the agent's own."""
    probability: Annotated[float, SHARE] = 0.5
    """Probability that the guide takes over an episode that lasts longer."""

    def init(self, num_envs: int) -> Running:
        """Return the state of first episodes, which stay the agent's own."""
        return Running(jnp.zeros(num_envs, bool), jnp.zeros(num_envs, jnp.int32))

    def guided(self, state: Running) -> Bool[Array, " num_envs"]:
        """Return in which environments the guide acts next."""
        return state.chosen & (state.steps >= self.after)

    def follow(self, state: Running, outcome: Outcome, scalars: Scalars, key: PRNGKeyArray) -> Running:
        """Count a step, and draw for the episodes that begin."""
        chosen = redraw(key, state.chosen, outcome.done, self.probability)
        return Running(chosen, jnp.where(outcome.done, 0, state.steps + 1))
