"""Find the action of a set with the largest value, for many observations at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.devices import portions
from cuelearner_jax.types import Action, Actions, Observation, Observations

ChoiceT = TypeVar("ChoiceT", bound=Any)  # an action, or a record of actions


def best_of(value: Callable[[Array, Array], Array], options: Float[Array, "m action"], obs: Observations) -> Actions:
    """Return the best action of a set in each situation, computing one portion of the situations at a time.

    `value`: (observation (obs,), actions (m, action)) -> values (m,).
    """
    return each_in_portions(lambda one: options[jnp.argmax(value(one, options))], obs, len(options))


def best_near_peaks(
    value: Callable[[Array, Array], Array],
    rough: Callable[[Array, Array], Array],
    options: Float[Array, "m action"],
    obs: Observations,
    coarse: int,
    peaks: int,
) -> Actions:
    """Return the choice of `best_of`, if the largest value lies next to a high peak of a coarse first look.

    The `options` are evenly spaced, the last beside the first. `rough` approximates `value` for the first look, at
    `coarse` of them, and the search goes on around so many of its `peaks`, up to their neighbours.
    """
    stride = len(options) // coarse

    def choose(one: Observation) -> Action:
        first = rough(one, options[::stride])
        summit = (first >= jnp.roll(first, 1)) & (first >= jnp.roll(first, -1))
        _, highest = jax.lax.top_k(jnp.where(summit, first, -jnp.inf), peaks)
        near = jnp.mod(highest[:, None] * stride + jnp.arange(1 - stride, stride)[None], len(options)).ravel()
        return options[near][jnp.argmax(value(one, options[near]))]

    return each_in_portions(choose, obs, coarse + peaks * (2 * stride - 1))


def each_in_portions(choose: Callable[[Array], ChoiceT], obs: Observations, actions: int) -> ChoiceT:
    """Return a choice among so many actions in each situation (leading axis n).

    As many situations at once as memory allows.
    """
    return jax.lax.map(choose, obs, batch_size=max(1, min(len(obs), portions().actions // actions)))
