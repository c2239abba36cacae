"""Critics that predict a distribution over bins of value: batch and weight normalisation, cross-entropy.

Source: Palenicek et al., "XQC: Well-conditioned optimization accelerates deep reinforcement learning",
arXiv:2509.25174, 2025. The projection onto bins: Bellemare et al., "A distributional perspective on reinforcement
learning", ICML 2017. One batch for steps and next steps, also in the target: Bhatt et al., "CrossQ", ICLR 2024.

Bins are in units of rms(reward) / (1 - discount) / `ROOM`. Values beyond the last bin count as it: those of rare large
rewards, and of entropy that is worth more than rewards (`first_temperature`). XQC divides rewards by a running
deviation of returns instead, which a minibatch of steps does not show. The first distribution is narrow: from equal
logits, which hold all values alike, agents learn the pendulum later.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.agents.networks import RATE
from cuelearner_jax.types import Params

BINS = np.linspace(-5.0, 5.0, 101, dtype=np.float32)  # their values, in units
ROOM = 2.0  # the bin of a value of rms(reward) / (1 - discount); the largest bin is 2.5 times that
FIRST = 0.2  # scale of the first distribution [units], Student's t of 3 degrees: narrow, with tails that can grow


class CategoricalCritic(nn.Module):
    """Logits of value's bins: normalised inputs, then dense layers without bias, each normalised before its ReLU."""

    layers: Sequence[int]

    @nn.compact
    def __call__(
        self, obs: Float[Array, "... obs"], action: Float[Array, "... action"], train: bool = False
    ) -> Float[Array, "... bins"]:
        """Leading axes of `obs` and `action` must broadcast. `train`: normalise by this batch, and count it."""
        lead = jnp.broadcast_shapes(obs.shape[:-1], action.shape[:-1])
        x = jnp.concatenate([jnp.broadcast_to(part, (*lead, part.shape[-1])) for part in (obs, action)], -1)
        x = nn.BatchNorm(not train, name="BatchNorm_in")(x)
        for width in self.layers:
            x = nn.relu(nn.BatchNorm(not train)(nn.Dense(width, use_bias=False)(x)))
        first = lambda *_: -2 * jnp.log1p((BINS / FIRST) ** 2)  # noqa: E731
        return nn.Dense(BINS.size, kernel_init=nn.initializers.zeros, bias_init=first, name="bins")(x)

    def start(self, key: PRNGKeyArray, obs: Float[Array, " obs"], action: Float[Array, " action"]) -> Params:
        """Return a critic's random parameters, running statistics, and the unit of its bins in reward."""
        return with_unit_weights({**self.init(key, obs, action), "unit": jnp.ones(())})

    def values(self, critic: Params, obs: Array, action: Array) -> Float[Array, "..."]:
        """Return expected values by the running statistics, in reward."""
        return jax.nn.softmax(jnp.asarray(self.apply(_variables(critic), obs, action))) @ BINS * critic["unit"]

    def by_batch(self, critic: Params, obs: Float[Array, "n obs"], action: Array) -> tuple[Float[Array, "n bins"], Any]:
        """Return logits by the statistics of these rows, and the new running statistics."""
        logits, state = self.apply(_variables(critic), obs, action, train=True, mutable="batch_stats")
        return jnp.asarray(logits), state["batch_stats"]

    def loss(
        self, critic: Params, obs: Float[Array, "n obs"], action: Array, target: Float[Array, "batch bins"]
    ) -> tuple[Float[Array, ""], Any]:
        """Return the cross-entropy of the first rows and the new statistics, which all rows enter.

        The rows are a batch's steps, and after them its next steps where there are any.
        """
        logits, statistics = self.by_batch(critic, obs, action)
        return -jnp.sum(target * jax.nn.log_softmax(logits[: len(target)]), -1).mean(), statistics


def _variables(critic: Params) -> Params:
    return {name: critic[name] for name in ("params", "batch_stats")}


def next_unit(
    unit: Array, rewards: Float[Array, " n"], discount: Array | float, count: Int[Array, ""]
) -> Float[Array, "..."]:
    """Return the unit of the bins [reward] after batch number `count` (from 1): a running root mean square."""
    square = jnp.mean(jnp.square(rewards / jnp.maximum(1 - discount, 1e-3) / ROOM))
    return jnp.sqrt(jnp.square(unit) + jnp.maximum(1 / count, RATE) * (square - jnp.square(unit)) + 1e-12)


def with_unit_weights(critic: Params) -> Params:
    """Return a critic whose hidden units each have incoming weights of length 1."""
    shorten = lambda kernel: kernel / (jnp.linalg.norm(kernel, axis=-2, keepdims=True) + 1e-8)  # noqa: E731
    layers = {
        name: {"kernel": shorten(layer["kernel"])} if name.startswith("Dense") else layer
        for name, layer in critic["params"].items()
    }
    return {**critic, "params": layers}


def project(values: Float[Array, "n atoms"], weights: Float[Array, "n atoms"]) -> Float[Array, "n bins"]:
    """Return distributions over the bins: each atom's weight goes to its two nearest bins, by closeness.

    `values` are in units of the bins; those beyond the last bin count as the last bin.
    """
    places = (jnp.clip(values, BINS[0], BINS[-1]) - BINS[0]) * (BINS.size - 1) / (BINS[-1] - BINS[0])
    lower = jnp.clip(jnp.floor(places), 0, BINS.size - 2).astype(jnp.int32)
    upward = weights * (places - lower)
    rows, empty = jnp.arange(len(values))[:, None], jnp.zeros((len(values), BINS.size))
    return empty.at[rows, lower].add(weights - upward).at[rows, lower + 1].add(upward)
