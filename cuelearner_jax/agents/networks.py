"""MLPs of an observation and an action, for action values and feedback models; and their inputs.

Inputs are observation and action, or the observation as it looks from the action. In the action's frame
(`frame` "action"), situations that differ by a rotation have the same inputs, and a network's output for one holds for
all of them. This is equivariance by the input (Wang, Walters, Platt, "SO(2)-equivariant reinforcement learning", ICLR
2022; van der Pol et al., "MDP homomorphic networks", NeurIPS 2020).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from cuelearner_jax.config import Frame, Start
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import Params

RATE = 1e-3  # share of a new batch in running means
FARTHEST = 10.0  # the largest normalised observation, in standard deviations


class Joined(nn.Module):
    """A dense layer on the concatenation of observation and action, computed without building the concatenation.

    Of many actions in one state, the observation's share is computed once.
    """

    width: int
    dtype: DTypeLike = jnp.float32
    start: Start = "xavier"

    @nn.compact
    def __call__(self, obs: Float[Array, "... obs"], action: Float[Array, "... action"]) -> Float[Array, "... width"]:
        """Leading axes of `obs` and `action` must broadcast."""
        shape = (obs.shape[-1] + action.shape[-1], self.width)
        of_kernel, of_bias = initializers(self.start, shape[0])
        kernel, bias = self.param("kernel", of_kernel, shape), self.param("bias", of_bias, (self.width,))
        obs, action, kernel, bias = (jnp.asarray(x, self.dtype) for x in (obs, action, kernel, bias))
        from_obs, from_action = obs @ kernel[: obs.shape[-1]], action @ kernel[obs.shape[-1] :]
        rank = max(from_obs.ndim, from_action.ndim)
        widen = lambda x: jnp.expand_dims(x, tuple(range(rank - x.ndim)))  # noqa: E731
        return (widen(from_obs) + widen(bias)) + widen(from_action)


class MLP(nn.Module):
    """ReLU layers on the concatenation of observation and action."""

    layers: Sequence[int]
    outputs: int
    dtype: DTypeLike = jnp.float32  # dtype of the hidden layers' arithmetic; parameters and outputs are float32
    layer_norm: bool = False  # whether hidden layers are normalised before their ReLU
    start: Start = "xavier"  # initial weights, see `initializers`

    @nn.compact
    def __call__(self, obs: Float[Array, "... obs"], action: Float[Array, "... action"]) -> Float[Array, "... outputs"]:
        """Leading axes of `obs` and `action` must broadcast."""
        x = nn.relu(self._normed(Joined(self.layers[0], self.dtype, self.start, name="Dense_0")(obs, action), 0))
        for place, width in enumerate(self.layers[1:], start=1):
            x = nn.relu(self._normed(self._dense(x, width, place, self.dtype), place))
        return self._dense(x, self.outputs, len(self.layers), jnp.float32)

    def _normed(self, x: Float[Array, "... width"], place: int) -> Float[Array, "... width"]:
        return nn.LayerNorm(dtype=self.dtype, name=f"LayerNorm_{place}")(x) if self.layer_norm else x

    def _dense(self, x: jax.Array, width: int, place: int, dtype: DTypeLike) -> jax.Array:
        kernel, bias = initializers(self.start, x.shape[-1])
        return nn.Dense(width, dtype=dtype, kernel_init=kernel, bias_init=bias, name=f"Dense_{place}")(x)


def initializers(start: Start, inputs: int) -> tuple[nn.initializers.Initializer, nn.initializers.Initializer]:
    """Return the initialisers of weights and biases of a layer with so many inputs.

    xavier: Xavier-uniform weights, zero biases. torch: both uniform within 1 / sqrt(inputs), as `torch.nn.Linear`.
    """
    if start == "xavier":
        return nn.initializers.xavier_uniform(), nn.initializers.zeros
    within = partial(jax.random.uniform, minval=-(inputs**-0.5), maxval=inputs**-0.5)
    return within, within


def next_moments(before: Params, obs: Float[Array, "batch obs"], count: Int[Array, ""]) -> Params:
    """Return mean and variance of observations after batch number `count` (from 1).

    The first 1 / `RATE` batches count alike. Both are exact for any mean, as after Welford (1962).
    """
    rate, now = jnp.maximum(1 / count, RATE), moments_of(obs, jnp.ones(len(obs), bool))
    change = now["mean"] - before["mean"]
    variance = (1 - rate) * (before["variance"] + rate * change**2) + rate * now["variance"]
    return {"mean": before["mean"] + rate * change, "variance": variance}


def moments_of(obs: Float[Array, "rows obs"], valid: Bool[Array, " rows"]) -> Params:
    """Return mean and variance of observations in some rows, for `normalised`.

    Neighbours are added first, so that the last bits depend neither on seeds beside nor on how many empty rows follow.
    """

    def mean(rows: Float[Array, "rows obs"]) -> Float[Array, " obs"]:
        rows = jax.lax.optimization_barrier(jnp.where(valid[:, None], rows, 0.0))
        while len(rows) > 1:
            rows = rows[::2] + jnp.pad(rows[1::2], ((0, len(rows) % 2), (0, 0)))
        return rows[0] / jnp.maximum(valid.sum(), 1)

    middle = mean(obs)
    return {"mean": middle, "variance": mean(jnp.square(obs - middle[None]))}


def normalised(obs: Float[Array, "... obs"], moments: Params | None, least: float = 1e-8) -> Float[Array, "... obs"]:
    """Return observations less their mean over their standard deviation, at most `FARTHEST`; as they are without.

    `least`: what is added to variances.
    """
    if moments is None:
        return obs
    mean, variance = (jnp.broadcast_to(moments[name], obs.shape) for name in ("mean", "variance"))
    return jnp.clip((obs - mean) / jnp.sqrt(variance + least), -FARTHEST, FARTHEST)


def q_network(layers: Sequence[int], dtype: DTypeLike = jnp.float32, layer_norm: bool = False) -> MLP:
    """Return a network Q(s, a) with one output."""
    return MLP(tuple(layers), 1, dtype, layer_norm)


def as_function(network: MLP) -> Callable[[Params, jax.Array, jax.Array], jax.Array]:
    """Return a network as a function (params, obs (..., obs), actions (..., action)) -> (..., outputs)."""
    return lambda params, obs, actions: jnp.asarray(network.apply(params, obs, actions))


def network_inputs(
    frame: Frame, space: Space, env: Any, obs: Float[Array, "*n obs"], actions: Float[Array, "*m action"]
) -> tuple[Float[Array, "*n own"], Float[Array, "*m turned"]]:
    """Return a network's inputs for observation and action.

    `frame`: "raw": the two, a box's actions from -1 to 1; "action": the features of `env`. `obs`: one observation
    (obs,) with any number of actions (*m, action), or n observations with one action each.
    """
    if frame == "raw":
        return obs, space.even(actions)
    features = env.features(obs, actions) if obs.ndim == 1 else jax.vmap(env.features)(obs, actions)
    return features.own, features.turned


def widths(frame: Frame, spaces: Spaces) -> tuple[int, int]:
    """Return the sizes of a network's two inputs. Raises UserError if the environment has no `features`."""
    if frame == "raw":
        return spaces.obs_size, spaces.actions.size
    if spaces.features is None:
        raise UserError(
            "sizes.frame is 'action', but this task does not define an observation as seen from an action "
            "(`features`): give --sizes.frame raw"
        )
    return spaces.features


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Return whether every number of a tree of arrays is finite."""
    numbers = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in numbers] or [jnp.array(True)]).all()


def widen_layers(params: Params, layers: Sequence[int], multiple: int) -> tuple[Params, tuple[int, ...]]:
    """Return the same function with hidden widths rounded up to multiples, as tensor cores need aligned rows.

    `layers` are the hidden widths of the network. The units that are added are zero throughout and add exactly nothing.
    """
    wider = tuple(-(-width // multiple) * multiple for width in layers)
    extra = [0, *(new - old for new, old in zip(wider, layers, strict=True)), 0]
    dense = {
        f"Dense_{place}": {
            "kernel": jnp.pad(params["params"][f"Dense_{place}"]["kernel"], ((0, before), (0, after))),
            "bias": jnp.pad(params["params"][f"Dense_{place}"]["bias"], (0, after)),
        }
        for place, (before, after) in enumerate(pairwise(extra))
    }
    return {"params": dense}, wider
