"""What is exported of a policy: its decision about one observation, what stands in it, and cases to hold it to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Policy, describe, layers, policy_name

TOLERANCE = 1e-5  # by which an entry of an action may differ elsewhere
NUDGE = 1e-6  # of an entry of an observation, as much as rounding may do
NUDGES, CASES = 4, 64
WALKERS, STEPS = 32, 4  # from which observations for golden cases are taken
CALLBACKS = {"pure_callback", "io_callback", "python_callback"}


def decision_of(policy: Policy) -> Callable[[PRNGKeyArray, Array], Array]:
    """A policy's decision: (key, observation (obs,)) -> action (action,).

    Raises UserError for a policy that looks at more than observations.
    """
    if any(layer.get("asks") for layer in layers(describe(policy))):
        raise UserError("this policy asks a teacher, who looks at the true state: export one that does not")
    return lambda key, obs: policy.act(key, None, obs[None])[0]


def row_by_row(policy: Policy) -> Callable[[Float[Array, "n obs"]], Float[Array, "n action"]]:
    """The decision about each of a batch: none hangs on the others, whatever their number."""
    decide = decision_of(policy)
    return lambda batch: jax.lax.map(lambda obs: decide(jax.random.key(0), obs), batch)


def observations(env: Environment, policy: Policy, count: int = WALKERS * STEPS) -> Float[np.ndarray, "n obs"]:
    """What a policy meets in a world: starts of episodes, and what follows from its own actions."""

    def step(walk: tuple[Any, Array], key: PRNGKeyArray) -> tuple[tuple[Any, Array], Array]:
        state, obs = walk
        action = policy.act(key, state, obs)
        state, found = jax.vmap(env.step)(jax.random.split(key, WALKERS), state, action)
        return (state, found.obs), obs

    @jax.jit
    def walked(key: PRNGKeyArray) -> Array:
        k_reset, k_run = jax.random.split(key)
        start = jax.vmap(env.reset)(jax.random.split(k_reset, WALKERS))
        return jax.lax.scan(step, start, jax.random.split(k_run, -(-count // WALKERS)))[1]

    seen = np.asarray(walked(jax.random.key(count)))
    return seen.reshape(-1, seen.shape[-1])[:count]


class Golden(NamedTuple):
    """Cases that a decision is held to."""

    obs: Float[np.ndarray, "cases obs"]
    actions: Float[np.ndarray, "cases action"]  # what JAX decided
    drawn: int  # observations that they were chosen among
    steady: int  # of these: decisions that do not hang on the last digits


def golden_cases(policy: Policy, drawn: Float[np.ndarray, "n obs"], most: int = CASES) -> Golden:
    """The first observations about which the decision stays the same when they are changed as little as by rounding.

    An argmax jumps where two values tie, and there another machine may well decide otherwise: such cases say nothing.

    Raises UserError if there is none.
    """
    drawn = np.asarray(drawn, np.float32)
    decide = jax.jit(row_by_row(policy))
    actions = np.asarray(decide(jnp.asarray(drawn)))
    user_code.check_actions(actions, policy_name(policy))
    random = np.random.default_rng(0)
    apart = np.zeros(len(drawn))
    for _ in range(NUDGES):
        nudge = NUDGE * random.uniform(-1, 1, drawn.shape) * np.maximum(np.abs(drawn), 1.0)
        nudged = np.asarray(decide(jnp.asarray(drawn + nudge, jnp.float32)))
        apart = np.maximum(apart, np.abs(nudged - actions).max(-1))
    steady = apart <= TOLERANCE
    if not steady.any():
        raise UserError(f"all of {len(drawn)} decisions hang on the last digits: nothing to check by")
    return Golden(drawn[steady][:most], actions[steady][:most], len(drawn), int(steady.sum()))
