"""The situations of a session, which its seed and the actions asked about determine: they need not be kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from cuelearner_jax import asking
from cuelearner_jax.environment import Environment
from cuelearner_jax.types import EnvState

SAME = 1e-5  # by which an observation may differ that is lived through anew

Advance = Callable[[Any, PRNGKeyArray, EnvState, Any], tuple[EnvState, Any]]  # (env, key, state, action)


class Keys(NamedTuple):
    """Random numbers of a session."""

    session: PRNGKeyArray  # of its questions and fits
    model: PRNGKeyArray
    start: PRNGKeyArray  # of the first situation


def keys_of(seed: int) -> Keys:
    """Those of a seed."""
    return Keys(*jax.random.split(jax.random.key(seed), 3))


@jax.jit
def begin(env: Environment, key: PRNGKeyArray) -> tuple[EnvState, jax.Array]:
    """The first situation of an episode: (state, observation)."""
    return env.reset(key)


@jax.jit
def advance(env: Environment, key: PRNGKeyArray, state: EnvState, action: jax.Array) -> tuple[EnvState, jax.Array]:
    """The situation that an action leads to: (state, observation)."""
    after, step = env.step(key, state, action)
    return after, step.obs


def lived(
    env: Environment, keys: Keys, rows: Iterable[tuple[np.ndarray, np.ndarray]]
) -> Iterator[tuple[EnvState, jax.Array]]:
    """Situation after situation: before each of the items, whose observations and actions `rows` hold, and after all.

    Ends early, before the first item that was seen otherwise: by a program of another version.
    """
    state, obs = begin(env, keys.start)
    for number, (seen, action) in enumerate(rows):
        if seen.shape != obs.shape or not np.allclose(np.asarray(obs), seen, atol=SAME):
            return
        yield state, obs
        key = asking.question_keys(keys.session, number).env
        state, obs = advance(env, key, state, jnp.asarray(action))
    yield state, obs
