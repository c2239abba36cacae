"""Baseline kinds without a model or questions: the agent alone, and the task's heuristic."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.guides.base import Guide, Kind
from cuelearner_jax.guides.refining import Refinement, no_refinement
from cuelearner_jax.types import GuidanceModel, Label


class Untaught(Guide):
    """A guide with an empty model: no guidance, the baseline of every other kind."""

    @property
    def moves(self) -> bool:
        """Whether the guide changes actions; False for no guidance, True for subclasses."""
        return type(self).act is not Untaught.act

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """Return an empty model."""
        return GuidanceModel({}, jnp.array(False))

    def fit(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """Return the former model."""
        return former

    def act(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return every action unchanged."""
        return no_refinement(actions)


class HeuristicGuide(Untaught):
    """The environment's heuristic as a guide."""

    def act(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return the heuristic's action in active rows."""
        return Refinement(jnp.where(active[:, None], jax.vmap(env.heuristic)(obs), actions), active.astype(jnp.int32))


NONE = Kind("none", "the agent alone", Untaught, title="no guidance", colour="#4d4d4d")
HEURISTIC = Kind("heuristic", "the task's obvious action", HeuristicGuide, needs=("heuristic",), colour="#D55E00")
