"""Guidance by demonstrations: an auxiliary policy is cloned from the actions that the teacher shows.

Source: paper, section V-A and appendix (the networks, the optimiser and the schedule of the relative model). Questions
are about what the policy itself would do, once there is one (DAgger: Ross, Gordon, Bagnell, 2011).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.feedback.answers import DEMONSTRATION
from cuelearner_jax.guides.auxiliary import auxiliary_policy
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.fitting import fit_least_squares, lessons
from cuelearner_jax.guides.kind import Kind
from cuelearner_jax.guides.questions import about_refined
from cuelearner_jax.guides.refining import Refined
from cuelearner_jax.types import GuidanceModel, Label


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle for an environment's spaces."""
    policy = auxiliary_policy(sizes, spaces)

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel(policy.init(key), jnp.array(False))

    def target(label: Label, scalars: GuideScalars) -> Float[Array, " action"]:
        """What was shown."""
        return label.answer

    def fit(key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars) -> GuidanceModel:
        rows, predict = lessons(labels, target, scalars), partial(policy.vectors, env)
        return fit_least_squares(
            key, rows, scalars, init=policy.init, apply=predict, sizes=sizes, redrawn=policy.seen_again
        )

    def act(
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        return policy.act(env, model.params, obs, actions, active & model.fitted, scalars)

    return Guidance("demonstration", DEMONSTRATION, init, about_refined(act), target, fit, act, policy.disagreement)


KIND = Kind("demonstration", "a policy cloned from what the teacher shows", make, form=DEMONSTRATION, colour="#009E73")
