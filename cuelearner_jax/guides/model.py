"""The network of a guide: what it sees, and what its outputs mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents import view
from cuelearner_jax.agents.networks import applied, residual_network
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guides.bundle import DisagreementFunction
from cuelearner_jax.guides.ensemble import ensemble
from cuelearner_jax.types import Params


class GuideModel(NamedTuple):
    """A network of observation and action, or the mean of an ensemble of such, as pure functions."""

    init: Callable[[PRNGKeyArray], Params]
    # (env, params, obs (n, obs), actions (n, action)) -> outputs (n, outputs)
    predict: Callable[[Any, Params, Array, Array], Array]
    disagreement: DisagreementFunction | None = None  # for the bundle; None: there is but one network


def guide_model(sizes: GuideSizes, spaces: Spaces, outputs: int, beside: int = 0) -> GuideModel:
    """A network whose outputs are numbers, such as the value of an action; with `ensemble` several, and their mean.

    Args:
        sizes: of the network.
        spaces: the environment's.
        outputs: how many numbers.
        beside: numbers that it sees beside observation and action: actions then have so many entries more, at the end.

    Raises UserError for a frame in which the environment cannot be seen.
    """
    network = residual_network(sizes.feedback_layers, outputs)
    own, turned = view.widths(sizes.frame, spaces)

    def init(key: PRNGKeyArray) -> Params:
        return network.init(key, jnp.zeros(own), jnp.zeros(turned + beside))

    def predict(
        env: Any, params: Params, obs: Float[Array, "n obs"], actions: Float[Array, "n action"]
    ) -> Float[Array, "n outputs"]:
        bare, known = jnp.split(actions, [spaces.actions.size], -1)
        of_obs, of_action = view.seen(sizes.frame, env, obs, bare)
        return applied(network)(params, of_obs, jnp.concatenate([of_action, known], -1) if beside else of_action)

    return GuideModel(*ensemble(sizes.ensemble, init, predict))


def residual_model(sizes: GuideSizes, spaces: Spaces, beside: int = 0) -> GuideModel:
    """A network whose outputs are something to add to the action, whichever frame it sees them in.

    `beside`: see `guide_model`.
    """
    inner = guide_model(sizes, spaces, spaces.actions.size, beside)

    def predict(env: Any, params: Params, obs: jax.Array, actions: jax.Array) -> jax.Array:
        outputs = inner.predict(env, params, obs, actions)
        return view.outward(sizes.frame, spaces, outputs, actions[..., : spaces.actions.size])

    return GuideModel(inner.init, predict, inner.disagreement)
