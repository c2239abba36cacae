"""Tools of the checks, and the checks of the smallest parts: action spaces and policies."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.policies import BY_LANE, SHARED
from cuelearner_jax.spaces import Space, from_json

SAMPLES = 64  # actions of a check of a space
ROWS = 9  # situations of a check of a policy


class Laws:
    """The laws of one subject; `subject`: the beginning of messages, a string or an object whose class is named."""

    def __init__(self, subject: Any, tolerance: float = 1e-5) -> None:
        self.subject = subject if isinstance(subject, str) else type(subject).__name__
        self.tolerance = tolerance

    def hold(self, law: Any, broken: str) -> None:
        """Raise AssertionError with the broken law and how to fix it, unless the law holds."""
        if not law:
            raise AssertionError(f"{self.subject}: {broken}")

    def same(self, one: Any, other: Any) -> bool:
        """Return whether two trees of arrays are equal, within the tolerance. Keys are compared by their words."""
        pairs = zip(*(map(_numbers, jax.tree.leaves(tree)) for tree in (one, other)), strict=True)
        near = lambda a, b: np.allclose(a, b, self.tolerance, self.tolerance, equal_nan=True)  # noqa: E731
        return all(a.shape == b.shape and near(a, b) for a, b in pairs)

    def actions(self, space: Space, actions: Any, subject: str) -> None:
        """Raise AssertionError unless rows (..., size) are actions of a space."""
        shape = np.shape(actions)
        self.hold(shape[-1:] == (space.size,), f"{subject} has shape {shape}: an action has {space.size} entries")
        self.hold(np.isfinite(actions).all(), f"{subject} is not finite everywhere: give an action in every situation")
        inside = self.same(space.retract(jnp.asarray(actions)), actions)
        self.hold(inside, f"{subject} is not an action of the space: pass it through the space's `retract`")


def shapes_of(tree: Any) -> Any:
    """Return a tree's structure with the shape and type of each leaf; two of them can be compared."""
    return jax.tree.structure(tree), [(np.shape(leaf), leaf.dtype) for leaf in jax.tree.leaves(tree)]


def _numbers(leaf: Any) -> np.ndarray:
    is_key = jnp.issubdtype(getattr(leaf, "dtype", np.float32), jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def check_space(space: Space) -> None:
    """Check an action space on actions that it draws. Raises AssertionError for the first law that is broken."""
    laws = Laws(space)
    hash(space)
    laws.hold(from_json(space.to_json()) == space, "its description gives another space: see `to_json`, `of_json`")
    one, other = (space.sample(jax.random.key(seed), (SAMPLES,)) for seed in (0, 1))
    change = jax.jit(space.log)(one, other)
    reached, retracted = jax.jit(space.exp)(one, change), space.retract(one)
    laws.hold(change.shape == (SAMPLES, len(space.cues)), f"`log` has shape {change.shape}: give one number a cue")
    for function, actions in (("sample", one), ("exp", reached), ("spread", space.spread(SAMPLES))):
        laws.actions(space, actions, f"what `{function}` gives")
    laws.hold(laws.same(retracted, one), "`retract` changes actions: it must leave them as they are")
    if space.cues:
        laws.hold(laws.same(reached, other), "exp(a, log(a, b)) is not b: `exp` must go where `log` says")
        farthest = float(np.max(np.abs(space.to_unit(np.asarray(change), np))))
        laws.hold(farthest <= space.reach * (1 + laws.tolerance), f"`log` goes as far as {farthest:g}: beyond `reach`")
    lost = space.retract(one.at[0].set(jnp.nan))
    laws.hold(np.isnan(lost[0]).all(), "`retract` of NaN is not NaN: return NaN, so that a fault of user code is seen")


def check_policy(policy: Any, env: Environment) -> None:
    """Check a policy in one environment. Raises AssertionError for the first law that is broken."""
    laws, space = Laws(policy), actions_of(env)
    keys = jax.random.split(jax.random.key(0), ROWS)
    states, obs = jax.vmap(env.reset)(keys)
    act = jax.jit(lambda policy, key, states, obs: policy.act(key, states, obs))
    actions, again, other = (act(policy, keys[number], states, obs) for number in (0, 0, 1))
    axes = jax.tree.leaves(policy.axes, is_leaf=lambda leaf: leaf is None)
    broken = "`axes` holds something else than BY_LANE and SHARED: replace every field"
    laws.hold(all(axis is SHARED or axis == BY_LANE for axis in axes), broken)
    alone = act(policy, keys[0], jax.tree.map(lambda leaf: leaf[:1], states), obs[:1])
    for rows, result in ((ROWS, actions), (1, alone)):
        shape = np.shape(result)
        laws.hold(shape == (rows, space.size), f"`act` returns shape {shape} for {rows} observations")
        laws.actions(space, result, "an action that `act` returns")
    laws.hold(laws.same(actions, again), "the same key gives other actions: draw all random numbers from the key")
    if laws.same(actions, other):  # random actions differ where rows have another order
        order = jnp.roll(jnp.arange(ROWS), 4)
        rolled = act(policy, keys[0], jax.tree.map(lambda leaf: leaf[order], states), obs[order])
        apart = laws.same(rolled, actions[order]) and laws.same(alone, actions[:1])
        laws.hold(apart, "the action in one situation depends on the others: rows must not look at each other")
