"""Validation: fixed-length roll-outs of any policy on episodes that nothing was trained or tuned on.

A roll-out is begun, walked in one stretch or in several, and summed up: the numbers are the same, bit by bit on a CPU.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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
    as there are. Give steps enough for the longest: while one has not ended, there is no mean over all of them.

    Returns:
        "reward" a step, every metric of the environment's, and, where it has outcomes, these (nan unless all first
        episodes have ended) and "finished", the share of first episodes that have.
    """
    _, seen = _walked(policy, env, key, _begun(env, key, num_envs), jnp.arange(steps // num_envs))
    return _summed(seen, num_envs)


class _Walk(NamedTuple):
    """Where a roll-out stands; leading axis: environments."""

    state: Any
    obs: Array
    first: Array  # is this still the first episode?


Seen = tuple[dict[str, Array], dict[str, Array]]  # of each step: means, and sums over the first episodes that it ended


def _begun(env: Environment, key: PRNGKeyArray, num_envs: int) -> _Walk:
    k_reset, _ = jax.random.split(key)
    state, obs = jax.vmap(env.reset)(jax.random.split(k_reset, num_envs))
    return _Walk(state, obs, jnp.ones(num_envs, bool))


def _walked(policy: Policy, env: Environment, key: PRNGKeyArray, walk: _Walk, indices: Array) -> tuple[_Walk, Seen]:
    """The steps of these numbers."""
    _, k_run = jax.random.split(key)
    num_envs = walk.first.shape[0]

    def one_step(walk: _Walk, index: jax.Array) -> tuple[_Walk, Seen]:
        state, obs, first = walk
        k_act, k_env = jax.random.split(jax.random.fold_in(k_run, index))
        action = policy.act(k_act, state, obs)
        state, step = jax.vmap(env.step)(jax.random.split(k_env, num_envs), state, action)
        done = step.terminated | step.truncated
        means = {"reward": step.reward.mean(), **{name: value.mean() for name, value in step.metrics.items()}}
        ends = {name: jnp.sum(value, where=first & done) for name, value in step.outcome.items()}
        if ends:
            ends["finished"] = jnp.sum(first & done)
        return _Walk(state, step.obs, first & ~done), (means, ends)

    return jax.lax.scan(one_step, walk, indices)


def _summed(seen: Seen, num_envs: int) -> dict[str, Float[Array, ""]]:
    """The metrics of all steps."""
    means, ends = seen
    metrics = {name: value.mean() for name, value in means.items()}
    if ends:
        finished = ends["finished"].sum()
        outcomes = {name: value.sum() / jnp.maximum(finished, 1) for name, value in ends.items() if name != "finished"}
        metrics |= {name: jnp.where(finished == num_envs, value, jnp.nan) for name, value in outcomes.items()}
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


def one_lane(policy: Policy, index: int | ArrayLike) -> Any:
    """One lane's policy out of a block's; by several indices (lanes,), a block of these lanes."""
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


MOST_STRETCHES = 25  # of a roll-out that is watched

Tell = Callable[[int, int], None]  # (done, of how many): called between stretches; what it raises ends the evaluation


def untold(done: int, count: int) -> None:
    """Nobody watches."""


def part_of(tell: Tell, number: int, parts: int) -> Tell:
    """Who is told of part `number` (from 0) of as many equal ones, one after the other."""
    return lambda done, count: tell(number * count + done, parts * count)


def watched(
    env: Environment, policy: Policy, key: PRNGKeyArray, num_envs: int, steps: int, tell: Tell = untold
) -> dict[str, np.ndarray]:
    """`rollout` of one policy in stretches. Returns metrics ()."""
    leaves, tree = jax.tree.flatten(policy)
    return _in_stretches(env, _Structure(tree, (False,) * len(leaves)), [], leaves, key, num_envs, steps, tell)


def watched_lanes(
    env: Environment, policy: Policy, key: PRNGKeyArray, num_envs: int, steps: int, tell: Tell = untold
) -> dict[str, np.ndarray]:
    """`evaluate_lanes` on one device, in stretches: as many lanes at once as it takes well. Metrics (lanes,)."""
    structure = _structure(policy)
    each, shared = structure.take_apart(policy)
    lanes = jnp.asarray(each[0]).shape[0]
    size = min(lanes, portions().agents)
    firsts, found = range(0, lanes, size), []
    for number, first in enumerate(firsts):
        rows = np.minimum(np.arange(first, first + size), lanes - 1)  # the last are repeated, which saves a compile
        part = [jnp.asarray(leaf)[rows] for leaf in each]
        told = part_of(tell, number, len(firsts))
        found.append(_in_stretches(env, structure, part, shared, key, num_envs, steps, told))
    return {name: np.concatenate([part[name] for part in found])[:lanes] for name in found[0]}


def _in_stretches(
    env: Environment,
    structure: _Structure,
    each: list[Array],
    shared: list[ArrayLike],
    key: PRNGKeyArray,
    num_envs: int,
    steps: int,
    tell: Tell,
) -> dict[str, np.ndarray]:
    """A roll-out of one policy, or of as many lanes as `each` has rows, side by side."""
    count = _stretches(steps // num_envs)
    walk, seen = _begin(env, key, num_envs=num_envs, lanes=len(each[0]) if each else 0), []
    for indices in np.arange(steps // num_envs).reshape(count, -1):
        tell(len(seen), count)
        walk, part = _walk(env, each, shared, key, walk, jnp.asarray(indices), structure=structure)
        seen.append(jax.device_get(part))  # what waits until the stretch is done
    tell(count, count)
    whole = jax.tree.map(lambda *parts: np.concatenate(parts, axis=-1), *seen)
    return jax.device_get(_sum_up(whole, num_envs=num_envs, lanes=bool(each)))


def _stretches(steps: int) -> int:
    """Into how many equal stretches so many steps are cut: one program serves them all, none of a single step.

    XLA unrolls a loop of one step, whose numbers may then differ in their last bit.
    """
    return max(count for count in range(1, MOST_STRETCHES + 1) if steps % count == 0 and (count == 1 or steps > count))


@partial(jax.jit, static_argnames=("num_envs", "lanes"))
def _begin(env: Any, key: PRNGKeyArray, *, num_envs: int, lanes: int) -> _Walk:
    walk = _begun(env, key, num_envs)
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], lanes, axis=0), walk) if lanes else walk


@partial(jax.jit, static_argnames=("structure",))
def _walk(
    env: Any, each: list[Array], shared: list[Array], key: PRNGKeyArray, walk: _Walk, indices: Array, *, structure
) -> tuple[_Walk, Seen]:
    def one(lane: list[Array], walk: _Walk) -> tuple[_Walk, Seen]:
        return _walked(structure.put_together(lane, shared), env, key, walk, indices)

    return jax.vmap(one)(each, walk) if each else one([], walk)


@partial(jax.jit, static_argnames=("num_envs", "lanes"))
def _sum_up(seen: Seen, *, num_envs: int, lanes: bool) -> dict[str, Array]:
    summed = partial(_summed, num_envs=num_envs)
    return jax.vmap(summed)(seen) if lanes else summed(seen)
