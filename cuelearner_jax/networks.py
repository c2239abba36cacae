"""The MLPs: action values and feedback models are functions of an observation and an action."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.types import Params


class MLP(nn.Module):
    """ReLU layers on the concatenation of observation and action; Xavier-uniform weights, zero biases."""

    layers: Sequence[int]
    outputs: int

    @nn.compact
    def __call__(self, obs: Float[Array, "... obs"], action: Float[Array, "... 2"]) -> Float[Array, "... outputs"]:
        """Leading axes of `obs` and `action` must broadcast."""
        leading = jnp.broadcast_shapes(obs.shape[:-1], action.shape[:-1])
        x = jnp.concatenate(
            [jnp.broadcast_to(obs, (*leading, obs.shape[-1])), jnp.broadcast_to(action, (*leading, action.shape[-1]))],
            axis=-1,
        )
        for width in self.layers:
            x = nn.relu(nn.Dense(width, kernel_init=nn.initializers.xavier_uniform())(x))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.xavier_uniform())(x)


def q_network(layers: Sequence[int]) -> MLP:
    """Q(s, a): one output."""
    return MLP(tuple(layers), 1)


def feedback_network(layers: Sequence[int]) -> MLP:
    """phi(s, a): a residual in the plane."""
    return MLP(tuple(layers), 2)


def applied(network: MLP) -> Callable[[Params, jax.Array, jax.Array], jax.Array]:
    """A network as a function: (params, obs (..., obs), actions (..., 2)) -> outputs (..., outputs)."""
    return lambda params, obs, actions: jnp.asarray(network.apply(params, obs, actions))
