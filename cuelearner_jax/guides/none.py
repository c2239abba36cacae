"""No guidance: the unguided agent that every other kind is compared with."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Bool, Float

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.kind import Kind
from cuelearner_jax.guides.refining import Refined, untouched
from cuelearner_jax.guides.unlabelled import unlabelled
from cuelearner_jax.types import GuidanceModel


def act(
    model: GuidanceModel,
    env: Any,
    obs: Float[Array, "n obs"],
    actions: Float[Array, "n action"],
    active: Bool[Array, " n"],
    scalars: GuideScalars,
) -> Refined:
    """Every action as it is."""
    return untouched(actions)


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle."""
    return unlabelled("none", act)


KIND = Kind("none", "the agent alone", make, title="no guidance", colour="#4d4d4d")
