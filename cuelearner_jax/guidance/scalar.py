"""Guidance by scalar feedback: a model of whether the teacher calls an action good, whose argmax acts.

Source: paper, section V-A and appendix; its public code fits a network like the agent's to labels of 1 and 0, and has
the network's own argmax labelled. Hardly any uniform action is good, so a model that is asked about its own choices
alone may never see one: a share `explored_fraction` of the questions stays about base actions.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.agent.choice import greedy_actions
from cuelearner_jax.agent.networks import applied, q_network
from cuelearner_jax.config import AgentSizes, GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guidance.answers import SCALAR
from cuelearner_jax.guidance.bundle import Guidance
from cuelearner_jax.guidance.fitting import fit_least_squares, lessons
from cuelearner_jax.guidance.kind import Kind
from cuelearner_jax.guidance.questions import about_refined
from cuelearner_jax.guidance.refining import Refined
from cuelearner_jax.types import GuidanceModel, Label, Params


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle for an environment's spaces."""
    space = spaces.actions
    searched = AgentSizes(q_layers=sizes.feedback_layers, directions=sizes.guide_directions)
    network = q_network(sizes.feedback_layers)

    def init_params(key: PRNGKeyArray) -> Params:
        return network.init(key, jnp.zeros(spaces.obs_size), jnp.zeros(space.size))

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel(init_params(key), jnp.array(False))

    def target(label: Label, scalars: GuideScalars) -> Float[Array, "1"]:
        """Whether it was called good."""
        return label.answer

    def fit(key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars) -> GuidanceModel:
        rows = lessons(labels, target, scalars)
        # No symmetries: what is predicted is no vector of the world.
        return fit_least_squares(key, None, rows, scalars, init=init_params, apply=applied(network), sizes=sizes)

    def act(
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        guided = active & model.fitted
        chosen = greedy_actions(searched, space, model.params, obs)
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

    return Guidance("scalar", SCALAR, init, question, target, fit, act)


KIND = Kind("scalar", "a model of which actions the teacher calls good", make, form=SCALAR, colour="#E69F00")
