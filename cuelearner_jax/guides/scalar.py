"""Guidance by scalar feedback: a model of whether the teacher calls an action good; its argmax acts.

Source: paper, section V-A and appendix. The paper's public code fits a network like the agent's to labels of 1 and 0,
and asks about the network's own argmax. Hardly any uniform action is good, so a model that is asked only about its own
choices may never see a good one: a share `explored_fraction` of the questions stays about base actions. For a label (s,
a, g), with g 1 for a good action and 0 for another, in any space:

    v = argmin over f of sum over labels of (f(s, a) - g)^2
    a <- argmax over `space.spread(guide_directions)` of v(s, a)

For choices `space.spread` returns all of them. In a box a fixed number of actions gets sparser with the box's size:
give more `guide_directions`.
"""

from __future__ import annotations

from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from cuelearner_jax.agents.choice import best_of
from cuelearner_jax.config import POSITIVE, SHARE, GuideScalars, part
from cuelearner_jax.feedback.answers import SCALAR
from cuelearner_jax.guides.base import Guide, Rows, replaced
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.types import Action, Actions, GuidanceModel, Observation, Observations


@part
class ScalarConfig:
    """Options of guidance by scalar feedback."""

    guide_directions: Annotated[int, POSITIVE] = 360
    """Directions over which the guide takes its argmax."""
    explored_fraction: Annotated[float, SHARE] = 0.25
    """Share of questions about base actions after the first fit, to find good actions."""


class Scalar(Guide):
    """A guide that executes the action of largest predicted value."""

    name, about = "scalar", "a model of which actions the teacher calls good"
    form, colour, config = SCALAR, "#E69F00", ScalarConfig
    outputs = 1  # whether an action is called good
    options: ScalarConfig

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Return the best of all actions in active rows of a fitted model."""
        value = lambda obs, actions: self.network.predict(env, model.params, obs, actions)[:, 0]  # noqa: E731
        best = best_of(value, self.spaces.actions.spread(self.options.guide_directions), obs)
        return replaced(best, actions, active & model.fitted)

    def question(
        self, key: PRNGKeyArray, model: GuidanceModel, env: Any, obs: Observation, base: Action, scalars: GuideScalars
    ) -> Action:
        """Return the base action in a share `explored_fraction` of questions, the guide's own action in the others."""
        k_explore, k_refined = jax.random.split(key)
        explores = jax.random.bernoulli(k_explore, self.options.explored_fraction)
        return jnp.where(explores, base, super().question(k_refined, model, env, obs, base, scalars))
