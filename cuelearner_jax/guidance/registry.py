"""The forms of guidance, each one bundle of pure functions: none, heuristic, relative.

`act` receives a batch of base actions and returns what is to be executed; it leaves rows that are not active as they
are.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.agent.networks import applied, feedback_network
from cuelearner_jax.config import Scalars, Sizes
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError
from cuelearner_jax.guidance import feedback
from cuelearner_jax.guidance.refining import Refined, refine, untouched
from cuelearner_jax.types import Guidance, GuidanceModel, Label

KINDS = ("none", "relative", "heuristic")


def make(kind: str, sizes: Sizes, obs_size: int) -> Guidance:
    """The guidance called `kind`. Raises UserError for another name."""
    if kind == "none":
        return _unlabelled("none", _identity)
    if kind == "heuristic":
        return _unlabelled("heuristic", _heuristic)
    if kind == "relative":
        return _relative(sizes, obs_size)
    raise UserError(f"unknown guidance {kind!r}: choose one of {', '.join(KINDS)}")


def _identity(
    model: GuidanceModel,
    env: Environment,
    obs: Float[Array, "batch obs"],
    actions: Float[Array, "batch 2"],
    active: Bool[Array, " batch"],
    scalars: Scalars,
) -> Refined:
    return untouched(actions)


def _heuristic(
    model: GuidanceModel,
    env: Any,
    obs: Float[Array, "batch obs"],
    actions: Float[Array, "batch 2"],
    active: Bool[Array, " batch"],
    scalars: Scalars,
) -> Refined:
    return Refined(jnp.where(active[:, None], jax.vmap(env.heuristic)(obs), actions), active.astype(jnp.int32))


def _unlabelled(name: str, act) -> Guidance:
    """A guidance that learns nothing and never asks."""

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel({}, jnp.array(False))

    def label(key: PRNGKeyArray, action: jax.Array, best: jax.Array, scalars: Scalars) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros(2), jnp.array(False)

    def fit(key: PRNGKeyArray, env: Environment, labels: Label, scalars: Scalars) -> GuidanceModel:
        return init(key)

    return Guidance(name, False, init, label, fit, act)


def _relative(sizes: Sizes, obs_size: int) -> Guidance:
    """The paper's method: a model of relative feedback that refines the agent's actions.

    The network predicts in units of eps, so that a small eps fits as easily as a large one: phi = eps * network.
    """
    network = feedback_network(sizes.feedback_layers)
    predict = applied(network)

    def init_params(key: PRNGKeyArray):
        return network.init(key, jnp.zeros(obs_size), jnp.zeros(2))

    def init(key: PRNGKeyArray) -> GuidanceModel:
        return GuidanceModel(init_params(key), jnp.array(False))

    def label(key: PRNGKeyArray, action: jax.Array, best: jax.Array, scalars: Scalars) -> tuple[jax.Array, jax.Array]:
        h, answered = feedback.human_answer(key, action, best, scalars)
        return feedback.relative_target(action, h, scalars.radians("eps")), answered

    def act(
        model: GuidanceModel,
        env: Environment,
        obs: Float[Array, "batch obs"],
        actions: Float[Array, "batch 2"],
        active: Bool[Array, " batch"],
        scalars: Scalars,
    ) -> Refined:
        return refine(
            lambda current: scalars.radians("eps") * predict(model.params, obs, current),
            actions,
            active & model.fitted,
            tau=scalars.radians("tau"),
            tau_max=scalars.radians("tau_max"),
            k_max=scalars.k_max,
        )

    def fit(key: PRNGKeyArray, env: Environment, labels: Label, scalars: Scalars) -> GuidanceModel:
        scaled = labels.replace(target=labels.target / scalars.radians("eps"))
        return feedback.fit(key, env, scaled, scalars, init=init_params, apply=predict, sizes=sizes)

    return Guidance("relative", True, init, label, fit, act)
