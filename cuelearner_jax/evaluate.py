"""Evaluation: fixed-length roll-outs of any policy on episodes that no training or tuning used.

A roll-out may run in one stretch or in several; the numbers are the same, on a CPU bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jax.sharding import Mesh
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.devices import BY_LANE, SHARED, commit_arrays, over_lanes, portions
from cuelearner_jax.environment import Environment, actions_of, plays_once
from cuelearner_jax.policies import Policy, PolicyNode, call_policy, lanes_in, policy_name

# Folded into the root key: episodes for reported figures only, and episodes for choosing settings.
SPLITS = {"validation": 1_000_003, "tuning": 1_000_001}


def episodes(split: str = "validation") -> PRNGKeyArray:
    """Return the key of a split's episodes; it is the same for every policy, seed and time."""
    return jax.random.fold_in(jax.random.key(0), SPLITS[split])


class Rollout(NamedTuple):
    """The results of a roll-out: means over all environments, and each environment's values, which are independent."""

    means: dict[str, Any]  # (*lanes,) over the environments, as `evaluate_policy` gives them
    # (*lanes, envs) means over an environment's own steps (those of its first episode, where the environment
    # `plays_once`); outcomes are of its first episode, nan until that has ended
    each: dict[str, Any]
    episode_steps: Any  # (*lanes, envs) int: of each environment's first episode, as far as it went


def _rolled(policy: Policy, env: Environment, key: PRNGKeyArray, num_envs: int, steps: int) -> Rollout:
    walk = _walked(policy, env, key, _begun(env, key, num_envs), jnp.arange(steps // num_envs))
    return _summed(walk, None if plays_once(env) else steps // num_envs)


class _Walk(NamedTuple):
    """The state of a roll-out; leading axis: environments."""

    state: Any
    obs: Array
    first: Array  # True during the first episode
    episode_steps: Array  # steps of the first episode so far
    sums: dict[str, Array]  # sums of rewards and metrics over the steps so far
    outcomes: dict[str, Array]  # outcomes of the first episode, NaN until it ends
    acts: Array  # True while all actions were finite


def _begun(env: Environment, key: PRNGKeyArray, num_envs: int) -> _Walk:
    k_reset, _ = jax.random.split(key)
    keys = jax.random.split(k_reset, num_envs)
    state, obs = jax.vmap(env.reset)(keys)
    _, step = jax.eval_shape(jax.vmap(env.step), keys, state, jnp.zeros((num_envs, actions_of(env).size)))
    sums = {name: jnp.zeros(num_envs) for name in ("reward", *step.metrics)}
    # NaN of the dtypes that steps have, so that one program serves both
    outcomes = dict.fromkeys(step.outcome, jnp.full(num_envs, jnp.nan, jnp.float32))
    yes = jnp.ones(num_envs, bool)
    return _Walk(state, obs, yes, jnp.zeros(num_envs, jnp.int32), sums, outcomes, yes)


_begin = jax.jit(_begun, static_argnames="num_envs")


def _walked(policy: Policy, env: Environment, key: PRNGKeyArray, walk: _Walk, indices: Array) -> _Walk:
    _, k_run = jax.random.split(key)
    num_envs, once = walk.first.shape[0], plays_once(env)

    def one_step(walk: _Walk, index: jax.Array) -> tuple[_Walk, None]:
        k_act, k_env = jax.random.split(jax.random.fold_in(k_run, index))
        action = call_policy(policy, k_act, walk.state, walk.obs, actions_of(env))
        acts = walk.acts & (jnp.isfinite(action).all(-1) | (once & ~walk.first))
        action = jnp.where(walk.first[:, None], action, jnp.nan) if once else action
        state, step = jax.vmap(env.step)(jax.random.split(k_env, num_envs), walk.state, action)
        done = step.terminated | step.truncated
        values, obs = {"reward": step.reward, **step.metrics}, step.obs
        if once:
            values = {name: jnp.where(walk.first, value, 0.0) for name, value in values.items()}
            obs = jnp.where(walk.first[:, None], obs, walk.obs)
        sums = {name: total + values[name] for name, total in walk.sums.items()}
        ends = walk.first & done
        outcomes = {name: jnp.where(ends, step.outcome[name], before) for name, before in walk.outcomes.items()}
        return _Walk(state, obs, walk.first & ~done, walk.episode_steps + walk.first, sums, outcomes, acts), None

    return jax.lax.scan(one_step, walk, indices)[0]


def _summed(walk: _Walk, steps: int | None) -> Rollout:
    """Return the results of a roll-out of so many steps an environment; None: of one episode each."""
    each = {name: total / (steps or walk.episode_steps) for name, total in walk.sums.items()} | walk.outcomes
    # Results after an invalid action are meaningless.
    each = {name: jnp.where(walk.acts, values, jnp.nan) for name, values in each.items()}
    if walk.outcomes:
        each["finished"] = 1.0 - walk.first
    return Rollout({name: values.mean() for name, values in each.items()}, each, walk.episode_steps)


def _apart(policy: PolicyNode) -> tuple[Any, Any]:
    """Split a policy into leaves that each lane has and leaves that lanes share, with None in place of the others."""
    by_lane = lambda axis, part: jax.tree.map(lambda _: axis is not None, part)  # noqa: E731
    own = jax.tree.map(by_lane, policy.axes, policy, is_leaf=lambda axis: axis is None)
    each = jax.tree.map(lambda own, leaf: leaf if own else None, own, policy)
    return each, jax.tree.map(lambda own, leaf: None if own else leaf, own, policy)


def _together(each: Any, shared: Any) -> Any:
    """Join what `_apart` split, also with one lane's leaves."""
    join = lambda own, common: common if own is None else own  # noqa: E731
    return jax.tree.map(join, each, shared, is_leaf=lambda leaf: leaf is None)


@partial(jax.jit, static_argnames=("num_envs", "steps"))
def evaluate_policy(
    env: Environment, policy: Policy, key: PRNGKeyArray, num_envs: int, steps: int
) -> dict[str, Float[Array, ""]]:
    """Return means over `steps` environment steps, shared by `num_envs` environments that reset automatically.

    These are "reward" a step, every metric of the environment's, and, where it has outcomes, these (nan unless all
    first episodes have ended) and "finished", the share of first episodes that have. Outcomes are those of each
    environment's first episode: the same episodes for every policy, long ones included. Give steps enough for the
    longest one, since without it there is no mean over all of them.
    """
    return _rolled(policy, env, key, num_envs, steps).means


def mean_interval(values: Float[np.ndarray, "*lanes n"], is_share: bool = False) -> Float[np.ndarray, "3 *lanes"]:
    """Return the mean of independent values and its 95% interval by Student's t (NaN for a single value).

    Of a share, whose values are all 0 or 1, the interval is that of Wilson's score, which holds near 0 and 1 too. For
    the difference of two policies, pass each environment's difference.
    """
    values = np.asarray(values, float)
    count, mean = values.shape[-1], values.mean(-1)
    if is_share and np.isin(values, (0, 1)).all():
        score = scipy.special.ndtri(0.975) ** 2 / count
        middle, half = mean + score / 2, np.sqrt(score * (mean * (1 - mean) + score / 4))
        return np.stack([mean, *np.clip([(middle - half) / (1 + score), (middle + half) / (1 + score)], 0, 1)])
    error = values.std(-1, ddof=1) / count**0.5 if count > 1 else np.full(mean.shape, np.nan)
    half = scipy.special.stdtrit(count - 1, 0.975) * error
    return np.stack([mean, mean - half, mean + half])


GROUPS = 20  # most groups of episodes whose means an evaluation keeps


def group_means(values: Float[np.ndarray, "*lanes envs"]) -> Float[np.ndarray, "*lanes groups"]:
    """Return means over up to `GROUPS` groups of environments, of equal size where at least ten groups can be.

    Of unequal groups all means are moved alike, so that their mean is that of the values.
    """
    count = values.shape[-1]
    number = next((n for n in range(GROUPS, 9, -1) if count % n == 0), min(GROUPS, count))
    groups = np.stack([part.mean(-1) for part in np.array_split(values, number, axis=-1)], -1)
    return groups + (values.mean(-1) - groups.mean(-1))[..., None] if count % number else groups


MOST_STRETCHES = 25  # most stretches of a roll-out with progress

Tell = Callable[[int, int], None]  # (done, of how many): called between stretches; what it raises ends the evaluation


def ignore_progress(count_so_far: int, count: int) -> None:
    """Ignore progress."""


def part_of(tell: Tell, number: int, parts: int) -> Tell:
    """Return a progress callback for part `number` (from 0) of as many equal parts, one after the other."""
    return lambda count_so_far, count: tell(number * count + count_so_far, parts * count)


def rollout_with_progress(
    env: Environment, policy: Policy, key: PRNGKeyArray, num_envs: int, steps: int, tell: Tell = ignore_progress
) -> Rollout:
    """Roll out one policy, as `evaluate_policy` does, in stretches. Returns NumPy arrays: means (), values (envs,)."""
    return _in_stretches(env, None, policy, key, num_envs, steps, tell, policy_name(policy))


def rollout_lanes(
    env: Environment,
    policy: PolicyNode,
    key: PRNGKeyArray,
    num_envs: int,
    steps: int,
    tell: Tell = ignore_progress,
    mesh: Mesh | None = None,
) -> Rollout:
    """Roll out a block of lanes on the same episodes. Returns NumPy arrays with a leading axis of lanes.

    Leaves of the policy that are `BY_LANE` in its `axes` have a leading axis of lanes; a policy that all lanes share
    counts as one lane. With a `mesh` its devices share the lanes, in one stretch without progress; without one it is
    done in stretches, as many lanes at once as the device takes well.
    """
    if (lanes := lanes_in(policy)) is None:
        alone = rollout_with_progress(env, policy, key, num_envs, steps, tell)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[None], alone)
    each, shared = _apart(policy)
    if mesh is not None:
        return jax.device_get(_on_mesh(env, each, shared, key, mesh=mesh, num_envs=num_envs, steps=steps))
    size = min(lanes, portions().agents)
    firsts, results = range(0, lanes, size), []
    for number, first in enumerate(firsts):
        # the last lanes are repeated, which saves a compile
        rows = np.minimum(np.arange(first, first + size), lanes - 1)
        part = jax.tree.map(lambda leaf, rows=rows: jnp.asarray(leaf)[rows], each)
        results.append(_in_stretches(env, part, shared, key, num_envs, steps, part_of(tell, number, len(firsts))))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:lanes], *results)


@partial(jax.jit, static_argnames=("mesh", "num_envs", "steps"))
def _on_mesh(env: Any, each: Any, shared: Any, key: PRNGKeyArray, *, mesh: Mesh, num_envs: int, steps: int) -> Rollout:
    def share(env: Any, each: Any, shared: Any, key: PRNGKeyArray) -> Rollout:
        one = lambda lane: _rolled(_together(lane, shared), env, key, num_envs, steps)  # noqa: E731
        return jax.lax.map(one, each, batch_size=min(len(jax.tree.leaves(each)[0]), portions().agents))

    return over_lanes(mesh, share, (SHARED, BY_LANE, SHARED, SHARED), BY_LANE)(env, each, shared, key)


def _in_stretches(
    env: Environment, each: Any, shared: Any, key: PRNGKeyArray, num_envs: int, steps: int, tell: Tell, whose: str = ""
) -> Rollout:
    """Roll out one policy (`each` is None), or the lanes of `each` side by side; a lane that fails is NaN."""
    count, lanes = _stretches(steps // num_envs), 0 if each is None else len(jax.tree.leaves(each)[0])
    once = plays_once(env)
    env, each, shared, key = commit_arrays((env, each, shared, key))
    walk = _begin(env, key, num_envs=num_envs)
    walk = _repeat(walk, lanes=lanes) if lanes else walk
    for number, indices in enumerate(np.arange(steps // num_envs).reshape(count, -1)):
        tell(number, count)
        walk = jax.block_until_ready(_walk(env, each, shared, key, walk, jnp.asarray(indices)))
        user_code.check_actions(True if lanes else walk.acts, whose)
        if once and not walk.first.any():
            break
    tell(count, count)
    return jax.device_get(_sum_up(walk, steps=None if once else steps // num_envs, lanes=bool(lanes)))


def _stretches(steps: int) -> int:
    """Return the number of equal stretches for so many steps, none of a single step: one program serves them all.

    XLA unrolls a loop of one step, whose numbers may then differ in their last bit.
    """
    return max(count for count in range(1, MOST_STRETCHES + 1) if steps % count == 0 and (count == 1 or steps > count))


@partial(jax.jit, static_argnames="lanes")
def _repeat(walk: _Walk, *, lanes: int) -> _Walk:
    """Repeat a beginning for each lane. Lanes and single policies thus share the program that makes the beginning."""
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], lanes, axis=0), walk)


@jax.jit
def _walk(env: Any, each: Any, shared: Any, key: PRNGKeyArray, walk: _Walk, indices: Array) -> _Walk:
    if each is None:
        return _walked(shared, env, key, walk, indices)
    return jax.vmap(lambda lane, walk: _walked(_together(lane, shared), env, key, walk, indices))(each, walk)


@partial(jax.jit, static_argnames=("steps", "lanes"))
def _sum_up(walk: _Walk, *, steps: int | None, lanes: bool) -> Rollout:
    summed = partial(_summed, steps=steps)
    return jax.vmap(summed)(walk) if lanes else summed(walk)
