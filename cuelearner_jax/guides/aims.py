"""Aims as a distribution over actions, and two kinds that choose an aim without labels: controls of `intent`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.environment import Aims
from cuelearner_jax.guides.base import Candidates, Kind
from cuelearner_jax.guides.baselines import Untaught
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import GuidanceModel

SPREAD = 1 / 180  # distance of a meant action from its aim, as a share of the space's reach
LEAST = 1e-12  # least probability before a logarithm


def open_aims(aims: Aims) -> Candidates:
    """Return which aims are possible and may be followed."""
    return Candidates(aims.actions, aims.possible if aims.open is None else aims.possible & aims.open)


def log_density(
    space: Space, aims: Float[Array, "aims action"], share: Float[Array, " aims_and_none"], actions: Float[Array, "m a"]
) -> Float[Array, " m"]:
    """Return the log density of actions, relative to the uniform density.

    A meant action lies around one of the aims, with a logistic error of `SPREAD` along each cue; for choices it is the
    aim itself. With the last probability of `share` it lies anywhere, so no action is ruled out.
    """
    if space.grain:
        same = space.distance(actions[:, None], aims[None]) < space.grain
        return _log_mixed(share, 1.0 * len(space.spread(1)) * same)
    # The range of a cue in spreads: directions reach to either side of any of them.
    extent = (2.0 if space == DIRECTIONS else 1.0) / SPREAD
    off = space.to_unit(space.log(actions[:, None], aims[None])) / (SPREAD * space.reach)
    each = extent * jax.nn.sigmoid(off) * jax.nn.sigmoid(-off)  # densities of logistic distributions
    near = each[..., 0] if len(space.cues) == 1 else each.prod(-1)
    return _log_mixed(share, near)


def _log_mixed(share: Float[Array, " aims_and_none"], near: Float[Array, "m aims"]) -> Float[Array, " m"]:
    return jnp.log(jnp.maximum(jnp.sum(share[None, :-1] * near, -1) + share[-1], LEAST))


class AnyAim(Untaught):
    """A guide that follows the nearest aim: what `intent` is before its first label."""

    def preference(self, env: Any, obs: Float[Array, " obs"], aims: Aims) -> Float[Array, " aims"]:
        """Return the log-weights of a situation's aims: all equal."""
        return jnp.zeros(len(aims.possible))

    def aim_weights(self, env: Any, obs: Float[Array, " obs"]) -> tuple[Aims, Float[Array, " aims"]]:
        """Return a situation's aims and their log-weights; minus infinity for aims that may not be followed."""
        aims = env.aims(obs)
        return aims, jnp.where(open_aims(aims).possible, self.preference(env, obs, aims), -jnp.inf)

    def candidates(self, env: Any, obs: Float[Array, " obs"]) -> Candidates:
        """Return the aims that may be followed."""
        return open_aims(env.aims(obs))

    def log_p(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, " obs"],
        actions: Float[Array, "m action"],
        scalars: GuideScalars,
    ) -> Float[Array, " m"]:
        """Return the log density of actions (`log_density`); "none of the aims" weighs as much as one aim."""
        aims, weights = self.aim_weights(env, obs)
        share = jax.nn.softmax(jnp.append(weights, 0.0))
        return log_density(self.spaces.actions, aims.actions, share, actions)

    def act(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return the nearest of the aims with the largest weight, in active rows; without any aim, the given action."""

        def one(obs: Array, action: Array) -> tuple[Array, Array]:
            aims, weights = self.aim_weights(env, obs)
            off = self.spaces.actions.distance(action[None], aims.actions)
            index = jnp.argmin(jnp.where(weights >= weights.max(), off, jnp.inf))
            return aims.actions[index], weights.max() > -jnp.inf

        goals, there = jax.vmap(one)(obs, actions)
        moved = active & there
        return Refinement(jnp.where(moved[:, None], goals, actions), moved.astype(jnp.int32))


class Rule(AnyAim):
    """A guide that weighs aims by the task's own rule."""

    def preference(self, env: Any, obs: Float[Array, " obs"], aims: Aims) -> Float[Array, " aims"]:
        """Return the log-weights of a situation's aims by the task's rule."""
        return env.rule(obs)


ANY_AIM = Kind("any_aim", "any of the task's aims, without a label", AnyAim, needs=("aims",), colour="#999933")
RULE = Kind("rule", "the task's own rule among its aims", Rule, needs=("aims", "rule"), colour="#882255")
