"""Which arm of an arbiter acts in the finished policy: each is validated in episodes that no figure is of."""

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
APART = 1  # folded into the key of the split: runs that are evaluated on that split do not meet their judge's episodes


def judges_world(config: RunConfig, environment: Callable[[str], Environment]) -> Environment | None:
    """The world in which arms are validated, of `environment` by split; None where there are no arms."""
    return environment(SPLIT) if isinstance(arbiter_of(config), Finishes) else None


def judges_episodes() -> PRNGKeyArray:
    """Key of the episodes in which arms are validated."""
    return jax.random.fold_in(episodes(SPLIT), APART)


def judges_envs(bootstraps: bool) -> int:
    """Environments that share the steps of a validation: few where only whole episodes count."""
    return 20 if bootstraps else 100


class Playing(NamedTuple):
    """An environment's state, and the discounted return of the running episode."""

    inner: Any
    earned: Float[Array, ""]
    factor: Float[Array, ""]  # discount to the power of the steps so far


class Returns(WholeObservations, struct.PyTreeNode):
    """An environment whose metrics are `ended`, 1 where an episode ends, and `returned`, its discounted return."""

    env: Any
    discount: Float[Array, ""] | float

    @property
    def observation(self) -> Any:
        """The environment's."""
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
    """What agents maximise, of a roll-out in `Returns`: reward a step, or, where targets bootstrap, return an episode.

    NaN where nothing can be said: an action was not finite. An arm that ends no episode has returned nothing.
    """
    if not bootstraps:
        return np.asarray(means["reward"])
    return np.asarray(means["returned"] / np.maximum(means["ended"], np.finfo(np.float32).tiny))


def scores(arms: list[dict[str, Any]], bootstraps: bool) -> np.ndarray:
    """Scores (arms, lanes) of the roll-outs of all arms, see `score`.

    In a lane where no arm has ended an episode, which may be longer than the validation, the reward a step tells.
    """
    found = np.stack([score(means, bootstraps) for means in arms])
    if not bootstraps:
        return found
    ended = np.stack([np.asarray(means["ended"]) for means in arms])
    return np.where((ended > 0).any(0), found, np.stack([np.asarray(means["reward"]) for means in arms]))
