"""Baseline kinds without a model or questions: the agent alone, the task's heuristic, the nearest of its aims."""

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


class AnyAim(Untaught):
    """A guide that follows the nearest aim: what `intent` is before its first label."""

    def act(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return the nearest of the aims that may be followed, in active rows; without any aim, the given action."""

        def one(obs: Array, action: Array) -> tuple[Array, Array]:
            aims = env.aims(obs)
            possible = aims.possible if aims.open is None else aims.possible & aims.open
            off = self.spaces.actions.distance(action[None], aims.actions)
            return aims.actions[jnp.argmin(jnp.where(possible, off, jnp.inf))], possible.any()

        goals, there = jax.vmap(one)(obs, actions)
        moved = active & there
        return Refinement(jnp.where(moved[:, None], goals, actions), moved.astype(jnp.int32))


NONE = Kind("none", "the agent alone", Untaught, title="no guidance", colour="#4d4d4d")
HEURISTIC = Kind("heuristic", "the task's obvious action", HeuristicGuide, needs=("heuristic",), colour="#D55E00")
ANY_AIM = Kind("any_aim", "any of the task's aims, without a label", AnyAim, needs=("aims",), colour="#999933")
