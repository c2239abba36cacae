"""The agent's choice: the action of its set with the largest value, for many observations at once."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.actions import Actions
from cuelearner_jax.agent import ddqn
from cuelearner_jax.agent.networks import applied, q_network, widened
from cuelearner_jax.config import AgentSizes
from cuelearner_jax.devices import portions
from cuelearner_jax.types import Params

ALIGNED = 64  # layers computed in bfloat16 are filled up to multiples: 20% faster on an H200, whose rows want alignment


def looked_at(sizes: AgentSizes) -> int:
    """Actions whose values one choice takes."""
    if not sizes.coarse_directions:
        return sizes.directions
    return sizes.coarse_directions + sizes.peaks * (2 * sizes.directions // sizes.coarse_directions - 1)


def greedy_actions(
    sizes: AgentSizes, actions: Actions, params: Params, obs: Float[Array, "n obs"]
) -> Float[Array, "n action"]:
    """The greedy actions of one agent, as its sizes have them searched: all of the set, or near the peaks."""
    choose = partial(
        _near_peaks if sizes.coarse_directions else _of_all, sizes, actions.spread(sizes.directions), params
    )
    return jax.lax.map(choose, obs, batch_size=max(1, min(len(obs), portions().actions // looked_at(sizes))))


def _of_all(
    sizes: AgentSizes, options: Float[Array, "m action"], params: Params, obs: Float[Array, " obs"]
) -> Float[Array, " action"]:
    return ddqn.greedy(applied(q_network(sizes.q_layers)), params, obs, options)


def _near_peaks(
    sizes: AgentSizes, options: Float[Array, "m action"], params: Params, obs: Float[Array, " obs"]
) -> Float[Array, " action"]:
    rough, layers = params, sizes.q_layers
    if sizes.coarse_dtype == "bfloat16":
        rough, layers = widened(params, layers, ALIGNED)
    look = applied(q_network(layers, jnp.dtype(sizes.coarse_dtype)))
    coarse = look(rough, obs, options[:: sizes.directions // sizes.coarse_directions])[:, 0]
    return ddqn.greedy_near_peaks(applied(q_network(sizes.q_layers)), params, obs, options, coarse, sizes.peaks)
