"""Guidance by the environment's own obvious action, which needs no learning."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.kind import Kind
from cuelearner_jax.guides.refining import Refined
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
    """The heuristic's action in active rows."""
    return Refined(jnp.where(active[:, None], jax.vmap(env.heuristic)(obs), actions), active.astype(jnp.int32))


def make(sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle."""
    return unlabelled("heuristic", act)


KIND = Kind("heuristic", "the task's obvious action", make, needs=("heuristic",), colour="#D55E00")
