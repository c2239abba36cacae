"""Validate an arbiter's arms and choose the one that acts in the finished policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.arbiters.protocol import Finishes
from cuelearner_jax.environment import Environment, WholeObservations, actions_of
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.policies import arbiter_of
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.types import Step

SPLIT = "tuning"
APART = 1  # folded into the split's key, so that no reported episode is used for validation


def judges_world(config: RunConfig, environment: Callable[[str], Environment]) -> Environment | None:
    """Return the world in which arms are validated (`environment` maps a split to it); None without arms."""
    return environment(SPLIT) if isinstance(arbiter_of(config), Finishes) else None


def judges_episodes() -> PRNGKeyArray:
    """Return the key of the episodes in which arms are validated."""
    return jax.random.fold_in(episodes(SPLIT), APART)


def judges_envs(bootstraps: bool) -> int:
    """Return how many environments share a validation's steps: few where only whole episodes count."""
    return 20 if bootstraps else 100


class Playing(NamedTuple):
    """An environment's state, with the discounted return of the running episode."""

    inner: Any
    earned: Float[Array, ""]
    factor: Float[Array, ""]  # discount to the power of the number of steps so far


class Returns(WholeObservations, struct.PyTreeNode):
    """An environment with metrics `ended` (1 at an episode's end) and `returned` (the discounted return there)."""

    env: Any
    discount: Float[Array, ""] | float

    @property
    def observation(self) -> Any:
        """The environment's observation slices."""
        return self.env.observation

    @property
    def actions(self) -> Any:
        """The environment's space of actions."""
        return actions_of(self.env)

    def reset(self, key: PRNGKeyArray) -> tuple[Playing, Float[Array, " obs"]]:
        """Start an episode."""
        state, obs = self.env.reset(key)
        return Playing(state, jnp.zeros(()), jnp.ones(())), obs

    def step(self, key: PRNGKeyArray, state: Playing, action: Float[Array, " action"]) -> tuple[Playing, Step]:
        """Execute an action."""
        inner, step = self.env.step(key, state.inner, action)
        done, earned = step.terminated | step.truncated, state.earned + state.factor * step.reward
        metrics = {"ended": done.astype(jnp.float32), "returned": jnp.where(done, earned, 0.0)}
        after = Playing(inner, jnp.where(done, 0.0, earned), jnp.where(done, 1.0, self.discount * state.factor))
        return after, step.replace(metrics=metrics, outcome={})


def score(means: dict[str, Any], bootstraps: bool) -> np.ndarray:
    """Return the agents' objective in a roll-out of `Returns`: reward per step; return per episode if bootstrapping.

    NaN where an action was not finite. An arm that ends no episode gets a return of 0.
    """
    if not bootstraps:
        return np.asarray(means["reward"])
    return np.asarray(means["returned"] / np.maximum(means["ended"], np.finfo(np.float32).tiny))


def scores(arms: list[dict[str, Any]], bootstraps: bool) -> np.ndarray:
    """Return the scores (arms, lanes) of the roll-outs of all arms, see `score`.

    In a lane where no arm ends an episode within the validation, the reward per step is used instead.
    """
    found = np.stack([score(means, bootstraps) for means in arms])
    if not bootstraps:
        return found
    ended = np.stack([np.asarray(means["ended"]) for means in arms])
    return np.where((ended > 0).any(0), found, np.stack([np.asarray(means["reward"]) for means in arms]))
