"""Guidance within a bound: of local corrections, which say nothing of what lies far from the action they are about."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.environment import actions_of
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.refining import Refined
from cuelearner_jax.types import GuidanceModel

GuideScalarsT = TypeVar("GuideScalarsT", bound=GuideScalars)


def within(scalars: GuideScalarsT, bound: Float[Array, ""]) -> GuideScalarsT:
    """Scalars with which refinement stays within `bound` [rad] of the first action, or nearer where it did before."""
    return dataclasses.replace(scalars, tau_max_deg=jnp.minimum(scalars.tau_max_deg, jnp.rad2deg(bound)))


def act_within(
    bound: Float[Array, ""],
    guidance: Guidance,
    model: GuidanceModel,
    env: Any,
    obs: Float[Array, "n obs"],
    actions: Float[Array, "n action"],
    active: Bool[Array, " n"],
    scalars: GuideScalars,
) -> Refined:
    """`guidance.act` that leads no farther than `bound` [rad] from the actions, whatever its kind does."""
    moved = guidance.act(model, env, obs, actions, active, within(scalars, bound))
    return moved._replace(actions=actions_of(env).clip(moved.actions, actions, bound))
