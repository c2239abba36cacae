"""Guidance by scalar feedback: a model of whether the teacher calls an action good, whose argmax acts.

Source: paper, section V-A and appendix; its public code fits a network like the agent's to labels of 1 and 0, and has
the network's own argmax labelled. Hardly any uniform action is good, so a model that is asked about its own choices
alone may never see one: a share `explored_fraction` of the questions stays about base actions.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.agents.choice import greedy_actions
from cuelearner_jax.config import AgentSizes, GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.feedback.answers import SCALAR
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.fitting import fit_least_squares, lessons
from cuelearner_jax.guides.kind import Kind
from cuelearner_jax.guides.model import guide_model
from cuelearner_jax.guides.questions import about_refined
from cuelearner_jax.guides.refining import Refined
from cuelearner_jax.types import GuidanceModel, Label


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle for an environment's spaces."""
    space = spaces.actions
    network = guide_model(sizes, spaces, 1)
    # The argmax is the agent's own, of a network of these layers in this frame.
    searched = AgentSizes(sizes.frame, sizes.feedback_layers, sizes.guide_directions)

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel(network.init(key), jnp.array(False))

    def target(label: Label, scalars: GuideScalars) -> Float[Array, "1"]:
        """Whether it was called good."""
        return label.answer

    def fit(key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars) -> GuidanceModel:
        rows = lessons(labels, target, scalars)
        predict = partial(network.predict, env)
        return fit_least_squares(key, rows, scalars, init=network.init, apply=predict, sizes=sizes)

    def act(
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        guided = active & model.fitted
        chosen = greedy_actions(searched, space, env, model.params, obs, sizes.ensemble)
        return Refined(jnp.where(guided[:, None], chosen, actions), guided.astype(jnp.int32))

    about_chosen = about_refined(act)

    def question(
        key: PRNGKeyArray,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, " obs"],
        base: Float[Array, " action"],
        scalars: GuideScalars,
    ) -> Float[Array, " action"]:
        k_explore, k_refined = jax.random.split(key)
        explores = jax.random.bernoulli(k_explore, scalars.explored_fraction)
        return jnp.where(explores, base, about_chosen(k_refined, model, env, obs, base, scalars))

    return Guidance("scalar", SCALAR, init, question, target, fit, act, network.disagreement)


KIND = Kind("scalar", "a model of which actions the teacher calls good", make, form=SCALAR, colour="#E69F00")
