"""What the kinds that learn nothing and never ask have in common."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.guides.bundle import ActFunction, Guidance
from cuelearner_jax.guides.questions import about_base
from cuelearner_jax.types import GuidanceModel, Label


def unlabelled(name: str, act: ActFunction) -> Guidance:
    """A guidance with an empty model."""

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel({}, jnp.array(False))

    def target(label: Label, scalars: GuideScalars) -> Float[Array, "0"]:
        return jnp.zeros(0)

    def fit(key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars) -> GuidanceModel:
        return former

    return Guidance(name, None, init, about_base, target, fit, act)
