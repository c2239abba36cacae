"""The agent's choice: the action of its set with the largest value, for many observations at once."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.actions import Actions
from cuelearner_jax.agents import ddqn, view
from cuelearner_jax.agents.networks import applied, q_network, widened
from cuelearner_jax.config import AgentSizes
from cuelearner_jax.devices import portions
from cuelearner_jax.environment import Spaces
from cuelearner_jax.types import Params

ALIGNED = 64  # layers computed in bfloat16 are filled up to multiples: 20% faster on an H200, whose rows want alignment


def values(sizes: AgentSizes, env: Any, dtype: DTypeLike = jnp.float32) -> ddqn.ValueFunction:
    """Q of an environment's observations and actions; `dtype` is that of the hidden layers' arithmetic."""
    network = applied(q_network(sizes.q_layers, dtype))
    return lambda params, obs, actions: network(params, *view.seen(sizes.frame, env, obs, actions))


def fresh_params(sizes: AgentSizes, spaces: Spaces, key: PRNGKeyArray) -> Params:
    """Random parameters of the action values."""
    own, turned = view.widths(sizes.frame, spaces)
    return q_network(sizes.q_layers).init(key, jnp.zeros(own), jnp.zeros(turned))


def looked_at(sizes: AgentSizes) -> int:
    """Actions whose values one choice takes."""
    if not sizes.coarse_directions:
        return sizes.directions
    return sizes.coarse_directions + sizes.peaks * (2 * sizes.directions // sizes.coarse_directions - 1)


def greedy_actions(
    sizes: AgentSizes, actions: Actions, env: Any, params: Params, obs: Float[Array, "n obs"], members: int = 1
) -> Float[Array, "n action"]:
    """The greedy actions of one agent, as its sizes have them searched: all of the set, or near the peaks.

    `env` says how an observation looks from an action; in the raw frame nobody asks it. Of several `members` (leading
    axis of `params`) it is the argmax of their mean value, over all of the set.
    """
    if members > 1:
        choose = partial(_of_mean, sizes, actions.spread(sizes.directions), env, params)
        return jax.lax.map(choose, obs, batch_size=max(1, min(len(obs), portions().actions // sizes.directions)))
    choose = partial(
        _near_peaks if sizes.coarse_directions else _of_all, sizes, actions.spread(sizes.directions), env, params
    )
    return jax.lax.map(choose, obs, batch_size=max(1, min(len(obs), portions().actions // looked_at(sizes))))


def _of_all(
    sizes: AgentSizes, options: Float[Array, "m action"], env: Any, params: Params, obs: Float[Array, " obs"]
) -> Float[Array, " action"]:
    return ddqn.greedy(values(sizes, env), params, obs, options)


def _of_mean(
    sizes: AgentSizes, options: Float[Array, "m action"], env: Any, params: Params, obs: Float[Array, " obs"]
) -> Float[Array, " action"]:
    def mean(params: Params, obs: Array, options: Array) -> Array:
        return jax.vmap(values(sizes, env), in_axes=(0, None, None))(params, obs, options).mean(0)

    return ddqn.greedy(mean, params, obs, options)


def _near_peaks(
    sizes: AgentSizes, options: Float[Array, "m action"], env: Any, params: Params, obs: Float[Array, " obs"]
) -> Float[Array, " action"]:
    rough, layers = params, sizes.q_layers
    if sizes.coarse_dtype == "bfloat16":
        rough, layers = widened(params, layers, ALIGNED)
    look = applied(q_network(layers, jnp.dtype(sizes.coarse_dtype)))
    first = options[:: sizes.directions // sizes.coarse_directions]
    coarse = look(rough, *view.seen(sizes.frame, env, obs, first))[:, 0]
    return ddqn.greedy_near_peaks(values(sizes, env), params, obs, options, coarse, sizes.peaks)
