"""Validation: fixed-length roll-outs of any policy on episodes that nothing was trained or tuned on."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.devices import BY_LANE, SHARED, over_lanes, portions
from cuelearner_jax.environment import Environment
from cuelearner_jax.policies import Policy

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
        action = policy.act(k_act, state, obs)
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


class _Structure(NamedTuple):
    """How a block's policy is put together again from the leaves that lanes have each and those that they share."""

    tree: Any
    by_lane: tuple[bool, ...]

    def take_apart(self, policy: Any) -> tuple[list[ArrayLike], list[ArrayLike]]:
        """(one for each lane, shared)"""
        leaves = jax.tree.leaves(policy)
        each = [leaf for leaf, own in zip(leaves, self.by_lane, strict=True) if own]
        return each, [leaf for leaf, own in zip(leaves, self.by_lane, strict=True) if not own]

    def put_together(self, each: list[ArrayLike], shared: list[ArrayLike]) -> Any:
        """The inverse, also of one lane's leaves."""
        own, common = iter(each), iter(shared)
        return jax.tree.unflatten(self.tree, [next(own if lane else common) for lane in self.by_lane])


def _structure(policy: Policy) -> _Structure:
    leaves, tree = jax.tree.flatten(policy)
    axes = jax.tree.map(
        lambda axis, part: jax.tree.map(lambda _: axis is not None, part),
        policy.axes,
        policy,
        is_leaf=lambda leaf: leaf is None,
    )
    found = _Structure(tree, tuple(jax.tree.leaves(axes)))
    assert len(found.by_lane) == len(leaves)
    return found


def one_lane(policy: Policy, index: int) -> Any:
    """One lane's policy out of a block's."""
    structure = _structure(policy)
    each, shared = structure.take_apart(policy)
    return structure.put_together([jnp.asarray(leaf)[index] for leaf in each], shared)


def evaluate_lanes(
    env: Environment, policy: Policy, key: PRNGKeyArray, *, mesh: Mesh, num_envs: int, steps: int
) -> dict[str, Float[Array, " lanes"]]:
    """Validation of a block of lanes, all on the same episodes.

    Args:
        env: the environment.
        policy: leaves that are `BY_LANE` in its `axes` have a leading axis of lanes.
        key: of the episodes.
        mesh: devices that share the lanes.
        num_envs, steps: as `rollout` has them.

    Returns:
        Metrics by name.
    """
    structure = _structure(policy)
    each, shared = structure.take_apart(policy)
    return _evaluate(env, each, shared, key, structure=structure, mesh=mesh, num_envs=num_envs, steps=steps)


@partial(jax.jit, static_argnames=("structure", "mesh", "num_envs", "steps"))
def _evaluate(
    env: Any, each: list[Array], shared: list[Array], key: PRNGKeyArray, *, structure, mesh, num_envs, steps
) -> dict[str, Float[Array, " lanes"]]:
    def share(env: Any, each: list[Array], shared: list[Array], key: PRNGKeyArray) -> dict[str, jax.Array]:
        def one(lane: list[Array]) -> dict[str, jax.Array]:
            return rollout(structure.put_together(lane, shared), env, key, num_envs, steps)

        # As many lanes at once as the device takes well.
        return jax.lax.map(one, each, batch_size=min(each[0].shape[0], portions().agents))

    return over_lanes(mesh, share, (SHARED, BY_LANE, SHARED, SHARED), BY_LANE)(env, each, shared, key)


@partial(jax.jit, static_argnames=("num_envs", "steps"))
def evaluate_policy(
    env: Environment, policy: Policy, key: PRNGKeyArray, num_envs: int, steps: int
) -> dict[str, Float[Array, ""]]:
    """`rollout` of one policy, compiled."""
    return rollout(policy, env, key, num_envs, steps)
