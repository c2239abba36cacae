"""Which action to ask about."""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.guides.bundle import ActFunction, QuestionFunction
from cuelearner_jax.types import GuidanceModel


def about_refined(act: ActFunction) -> QuestionFunction:
    """Questions about what the model would make of the base action, in a share `refined_fraction` of all.

    Source: DAgger (Ross, Gordon, Bagnell, 2011): what is asked about follows what will be met. An unfitted model leaves
    base actions as they are.
    """

    def question(
        key: PRNGKeyArray,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, " obs"],
        base: Float[Array, " action"],
        scalars: GuideScalars,
    ) -> Float[Array, " action"]:
        refine = jax.random.bernoulli(key, scalars.refined_fraction)
        return act(model, env, obs[None], base[None], refine[None], scalars).actions[0]

    return question


def about_base(
    key: PRNGKeyArray,
    model: GuidanceModel,
    env: Any,
    obs: Float[Array, " obs"],
    base: Float[Array, " action"],
    scalars: GuideScalars,
) -> Float[Array, " action"]:
    """Questions about the base action itself."""
    return base
