"""An auxiliary policy: a network of what to do, which acts in the agent's place in guided episodes.

Source: paper, section V-A ("train an auxiliary policy that imitates the human teacher"); what it is taught differs by
kind. On raw observations it sees nothing else. In the action's frame it sees the situation from some direction and
says which way its action lies from there. It is taught from all directions, for what is to be done hangs on none; and
it looks again from the action that it came to, until that settles: from there it sees best.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.actions import Actions
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guides.bundle import DisagreementFunction
from cuelearner_jax.guides.fitting import Lesson
from cuelearner_jax.guides.model import guide_model, residual_model
from cuelearner_jax.guides.refining import Refined, refine
from cuelearner_jax.types import GuidanceModel, Params


class AuxiliaryPolicy(NamedTuple):
    """Functions of one policy's parameters."""

    init: Callable[[PRNGKeyArray], Params]
    # (env, params, obs (n, obs), from where they are seen (n, action)) -> what it would do, vectors (n, action)
    vectors: Callable[[Any, Params, Array, Array], Array]
    # (key, lessons (n, ...) whose targets are actions) -> the same, seen from where a policy sees
    seen_again: Callable[[PRNGKeyArray, Lesson], Lesson]
    space: Actions
    looks_again: bool  # does what it does hang on from where it sees?
    disagreement: DisagreementFunction | None  # of the members of an ensemble, for the bundle

    def act(
        self,
        env: Any,
        params: Params,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refined:
        """Its actions in place of those of active rows, within the bound round them."""
        return refine(
            lambda current: self.vectors(env, params, obs, current) - current,
            actions,
            active,
            space=self.space,
            tau=scalars.radians("tau"),
            tau_max=scalars.radians("tau_max"),
            k_max=scalars.k_max if self.looks_again else 1,
        )


def auxiliary_policy(sizes: GuideSizes, spaces: Spaces) -> AuxiliaryPolicy:
    """A policy for an environment's spaces, which sees what networks of these sizes see."""
    if sizes.frame == "raw":
        network = guide_model(sizes, spaces, spaces.actions.size)

        def alone(env: Any, params: Params, obs: Array, views: Array) -> Array:
            return network.predict(env, params, obs, jnp.zeros_like(views))

        def apart(model: GuidanceModel, env: Any, obs: Array, actions: Array) -> Array:
            assert network.disagreement is not None
            return network.disagreement(model, env, obs, jnp.zeros_like(actions))

        members = apart if network.disagreement else None
        return AuxiliaryPolicy(network.init, alone, lambda key, batch: batch, spaces.actions, False, members)
    turning = residual_model(sizes, spaces)

    def from_there(env: Any, params: Params, obs: Array, views: Array) -> Array:
        return views + turning.predict(env, params, obs, views)

    return AuxiliaryPolicy(
        turning.init, from_there, partial(_elsewhere, spaces.actions), spaces.actions, True, turning.disagreement
    )


def _elsewhere(space: Actions, key: PRNGKeyArray, batch: Lesson) -> Lesson:
    """Half of a batch seen from anywhere, for it may be asked from there; half from the actions asked about."""
    k_half, k_where = jax.random.split(key)
    half = jax.random.bernoulli(k_half, 0.5, (batch.action.shape[0], 1))
    return batch.replace(action=jnp.where(half, space.uniform(k_where, (batch.action.shape[0],)), batch.action))
