"""Check the laws of a policy (`cuelearner_jax.policies.PolicyNode`) in one environment."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.policies import BY_LANE, SHARED
from cuelearner_jax.testing.laws import Laws, OnceTraced, change_floats, pytree

ROWS = 9


def check_policy(policy: Any, env: Environment, tolerance: float = 1e-5) -> None:
    """Check that a policy keeps its laws. Raises AssertionError for the first law that is broken.

    Args:
        policy: one policy, as `evaluate.evaluate_policy` takes it.
        env: the environment that it acts in.
        tolerance: relative and absolute, of actions.
    """
    laws, space = Laws(policy, tolerance), actions_of(env)
    pytree(laws, policy, "the policy")
    leaves, tree = jax.tree.flatten(policy)
    with laws.attempted("rebuilding it from its leaves", "its constructor must take whatever stands for its fields"):
        policy = jax.tree.unflatten(tree, leaves)
    _check_axes(laws, policy)
    keys = jax.random.split(jax.random.key(0), ROWS)
    states, obs = jax.vmap(env.reset)(keys)
    act = OnceTraced(lambda policy, key, states, obs: policy.act(key, states, obs))
    with laws.attempted("`act` under jit", "it gets a key, states and observations (n, obs), all traced"):
        actions, again, other = (act(policy, keys[number], states, obs) for number in (0, 0, 1))
        act(change_floats(policy), keys[0], states, obs)
    laws.hold(act.traces == 1, "other values of its floats are traced anew: keep them out of static fields")
    with laws.attempted("`act` of one observation", "n may be 1"):
        alone = act(policy, keys[0], jax.tree.map(lambda leaf: leaf[:1], states), obs[:1])
    for rows, found in ((ROWS, actions), (1, alone)):
        shape = np.shape(found)
        laws.hold(shape == (rows, space.size), f"`act` returns shape {shape} for {rows} observations")
        laws.actions(space, found, "an action that `act` returns")
    laws.hold(laws.same(actions, again), "the same key gives other actions: draw all random numbers from the key")
    if laws.same(actions, other):  # random actions differ where rows have another order
        order = jnp.roll(jnp.arange(ROWS), 4)
        moved = act(policy, keys[0], jax.tree.map(lambda leaf: leaf[order], states), obs[order])
        apart = laws.same(moved, actions[order]) and laws.same(alone, actions[:1])
        laws.hold(apart, "the action in one situation depends on the others: rows must not look at each other")


def _check_axes(laws: Laws, policy: Any) -> None:
    """Check that `axes` is a prefix of the policy, with `BY_LANE` or `SHARED` in place of fields."""

    def known(axis: Any, part: Any) -> bool:
        return axis is SHARED or (isinstance(axis, int) and axis == BY_LANE) or axis is part

    with laws.attempted("`axes`", "give the policy with BY_LANE or SHARED in place of its fields: self.replace(...)"):
        found = jax.tree.map(known, policy.axes, policy, is_leaf=lambda leaf: leaf is None)
    laws.hold(all(jax.tree.leaves(found)), "`axes` holds something else than BY_LANE and SHARED: replace every field")
