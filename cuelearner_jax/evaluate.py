"""Validation: fixed-length roll-outs of any policy on episodes that nothing was trained or tuned on."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import actions as geometry
from cuelearner_jax.agent.choice import greedy_actions
from cuelearner_jax.config import Scalars, Sizes
from cuelearner_jax.devices import BY_LANE, SHARED, over_lanes, portions
from cuelearner_jax.environment import Environment
from cuelearner_jax.guidance.feedback import relative_feedback, relative_target
from cuelearner_jax.guidance.refining import refine
from cuelearner_jax.types import Guidance, GuidanceModel, Params, Teacher

# (key, environment states (n, ...), observations (n, obs)) -> directions (n, 2)
Policy = Callable[[PRNGKeyArray, Any, jax.Array], jax.Array]

# Folded into the root key: episodes for reported figures only, and episodes for choosing settings.
SPLITS = {"validation": 1_000_003, "tuning": 1_000_001}


def episodes(split: str = "validation") -> PRNGKeyArray:
    """Key of the episodes of a split; the same for every policy, seed and time."""
    return jax.random.fold_in(jax.random.key(0), SPLITS[split])


def rollout(
    policy: Policy, env: Environment, key: PRNGKeyArray, num_envs: int, steps: int
) -> dict[str, Float[Array, ""]]:
    """Means over `steps` environment steps, shared by `num_envs` environments that reset by themselves.

    Outcomes are those of each environment's first episode: the same episodes whatever the policy, and as many long ones
    as there are. Give steps enough for the longest; "finished" is the share of first episodes that did end.

    Returns:
        "reward" a step, every metric of the environment's, and, where it has outcomes, these and "finished".
    """
    k_reset, k_run = jax.random.split(key)
    state, obs = jax.vmap(env.reset)(jax.random.split(k_reset, num_envs))

    def one_step(carry: tuple, index: jax.Array) -> tuple[tuple, tuple[dict, dict]]:
        state, obs, first = carry
        k_act, k_env = jax.random.split(jax.random.fold_in(k_run, index))
        action = policy(k_act, state, obs)
        state, step = jax.vmap(env.step)(jax.random.split(k_env, num_envs), state, action)
        done = step.terminated | step.truncated
        means = {"reward": step.reward.mean(), **{name: value.mean() for name, value in step.metrics.items()}}
        ends = {name: jnp.sum(value, where=first & done) for name, value in step.outcome.items()}
        if ends:
            ends["finished"] = jnp.sum(first & done)
        return (state, step.obs, first & ~done), (means, ends)

    start = (state, obs, jnp.ones(num_envs, bool))
    _, (means, ends) = jax.lax.scan(one_step, start, jnp.arange(steps // num_envs))
    metrics = {name: value.mean() for name, value in means.items()}
    if ends:
        finished = ends.pop("finished").sum()
        metrics |= {name: value.sum() / jnp.maximum(finished, 1) for name, value in ends.items()}
        metrics["finished"] = finished / num_envs
    return metrics


def agent_policy(sizes: Sizes, params: Params) -> Policy:
    """The greedy choice of an action-value network."""
    return lambda key, state, obs: greedy_actions(sizes, params, obs)


def uniform_policy() -> Policy:
    """Uniform directions."""
    return lambda key, state, obs: geometry.uniform(key, (obs.shape[0],))


def teacher_policy(teacher: Teacher) -> Policy:
    """What a teacher holds for best."""
    return lambda key, state, obs: _best_actions(teacher, state, obs)


def _best_actions(teacher: Teacher, state: Any, obs: jax.Array) -> jax.Array:
    # Few states at a time: a teacher by search simulates hundreds of actions of each.
    ask = lambda pair: teacher.best_action(*pair)  # noqa: E731
    return jax.lax.map(ask, (state, obs), batch_size=min(len(obs), portions().states))


def heuristic_policy(env: Environment) -> Policy:
    """The environment's own heuristic."""
    return lambda key, state, obs: jax.vmap(env.heuristic)(obs)


def guided_policy(base: Policy, guidance: Guidance, model: GuidanceModel, env: Environment, scalars: Scalars) -> Policy:
    """Another policy's actions, every one of them under guidance."""

    def policy(key: PRNGKeyArray, state: Any, obs: jax.Array) -> jax.Array:
        everywhere = jnp.ones(obs.shape[0], bool)
        return guidance.act(model, env, obs, base(key, state, obs), everywhere, scalars)[0]

    return policy


def corrected_policy(base: Policy, teacher: Teacher, scalars: Scalars) -> Policy:
    """Another policy's actions, refined by the teacher's own relative feedback instead of a model of it."""

    def policy(key: PRNGKeyArray, state: Any, obs: jax.Array) -> jax.Array:
        best, eps = _best_actions(teacher, state, obs), scalars.radians("eps")
        told = jax.vmap(lambda action, best: relative_target(action, relative_feedback(action, best, eps), eps))
        return refine(
            lambda actions: told(actions, best),
            base(key, state, obs),
            jnp.ones(obs.shape[0], bool),
            tau=scalars.radians("tau"),
            tau_max=scalars.radians("tau_max"),
            k_max=scalars.k_max,
        ).actions

    return policy


@partial(jax.jit, static_argnames=("mesh", "sizes", "num_envs", "steps"))
def evaluate_agents(
    env: Environment, params: Params, key: PRNGKeyArray, *, mesh: Mesh, sizes: Sizes, num_envs: int, steps: int
) -> dict[str, Float[Array, " lanes"]]:
    """Validation of a block of agents (leading axis of `params`), all on the same episodes."""

    def share(env: Environment, params: Params, key: PRNGKeyArray) -> dict[str, jax.Array]:
        return each_lane(lambda lane: rollout(agent_policy(sizes, lane), env, key, num_envs, steps), params)

    return over_lanes(mesh, share, (SHARED, BY_LANE, SHARED), BY_LANE)(env, params, key)


def each_lane(measure: Callable[[Any], dict[str, jax.Array]], lanes: Any) -> dict[str, Float[Array, " lanes"]]:
    """`measure` of every lane (leading axis), as many at once as the device takes well."""
    count = jax.tree.leaves(lanes)[0].shape[0]
    return jax.lax.map(measure, lanes, batch_size=min(count, portions().agents))


@partial(jax.jit, static_argnames=("mesh", "guidance", "num_envs", "steps"))
def evaluate_guides(
    env: Environment,
    models: GuidanceModel,
    key: PRNGKeyArray,
    scalars: Scalars,
    *,
    mesh: Mesh,
    guidance: Guidance,
    num_envs: int,
    steps: int,
) -> dict[str, Float[Array, " lanes"]]:
    """How good guidance is by itself: uniform actions under it, for a block of lanes on the same episodes."""

    def share(env: Environment, models: GuidanceModel, key: PRNGKeyArray, scalars: Scalars) -> dict[str, jax.Array]:
        def one(model: GuidanceModel) -> dict[str, jax.Array]:
            return rollout(guided_policy(uniform_policy(), guidance, model, env, scalars), env, key, num_envs, steps)

        return jax.vmap(one)(models)

    return over_lanes(mesh, share, (SHARED, BY_LANE, SHARED, SHARED), BY_LANE)(env, models, key, scalars)
