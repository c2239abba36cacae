"""Roll out one environment step by step for pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from cuelearner_jax.types import Policy, Step


def record_steps(
    env: Any, policy: Policy, key: PRNGKeyArray, steps: int, see: Callable[[Any, Any, jax.Array, Step], Any]
) -> list[Any]:
    """Return `see(env, state, action, step)` of each step in NumPy arrays; a new episode follows the end of one."""

    @jax.jit
    def play(env: Any, key: PRNGKeyArray) -> Any:
        k_reset, k_play = jax.random.split(key)

        def advance(carry: Any, number: jax.Array) -> Any:
            state, obs = carry
            k_act, k_step = jax.random.split(jax.random.fold_in(k_play, number))
            action = policy.act(k_act, jax.tree.map(lambda leaf: leaf[None], state), obs[None])[0]
            following, step = env.step(k_step, state, action)
            return (following, step.obs), see(env, state, action, step)

        return jax.lax.scan(advance, env.reset(k_reset), jnp.arange(steps))[1]

    rows = jax.device_get(play(env, key))
    return [jax.tree.map(lambda leaf, number=number: leaf[number], rows) for number in range(steps)]
