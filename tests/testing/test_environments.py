"""The laws of environments: kept by the probes and by our own tasks, each broken by one small environment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from probes import Aimed, Chain, Window, long_but

from cuelearner_jax.environment import Features, Quantity
from cuelearner_jax.spaces.directions import rotate
from cuelearner_jax.testing import check_environment


def altered(**changes):
    """The bandit with other fields of what its step returns."""

    class Altered(Window):
        def step(self, key, state, action):
            after, step = super().step(key, state, action)
            return after, step.replace(**{name: change(step, after) for name, change in changes.items()})

    return Altered()


def other(base=Window, **members):
    """The bandit, or another probe, with other members."""
    return type("Other", (base,), {"__module__": __name__, **members})()


class Listed(Window):
    extra: str = "a word"


class Unhashable(Window):
    table: np.ndarray = struct.field(pytree_node=False, default_factory=lambda: np.zeros(2))


class Bare:
    """No pytree."""

    observation = Window.observation
    reset, step = Window.reset, Window.step


def stepping(change, base=Window):
    """A probe whose step is changed: (state before, state after, step) -> (state, step)."""

    def step(self, key, state, action):
        return change(state, *base.step(self, key, state, action))

    return other(base, step=step)


class Branching(Window):
    def step(self, key, state, action):
        return super().step(key, state, -action if action[0] > 0 else action)


class Outside(Window):
    def reset(self, key):
        state, obs = super().reset(key)
        return state, obs * np.random.default_rng().uniform()


@jax.custom_batching.custom_vmap
def _neighbourly(reward):
    return reward


@_neighbourly.def_vmap
def _neighbourly_rows(size, batched, rewards):
    return rewards + 1.0, True


class Unequal(Aimed):
    def aims(self, obs):
        return super().aims(obs)._replace(possible=jnp.ones(3, bool))


class Pointless(Aimed):
    possible = (False, False, False, False)


def mirrored(image):
    """The bandit with another `mirror`."""
    return other(symmetries=2, mirror=lambda self, *given: image(*given))


BROKEN = {
    "obs_size": (other(observation=(Quantity("a", 3, "1"),)), "observation is float32 of shape (2,): make it"),
    "a name twice": (other(observation=(Quantity("a", 1, "1"),) * 2), "give each a name of its own"),
    "no unit": (other(observation=(Quantity("a", 2, ""),)), "lacks a name, a unit"),
    "no array": (Listed(), "field extra is of type str, which is not traced"),
    "no hash": (Unhashable(), "a static field must be hashable"),
    "no pytree": (Bare(), "is not a pytree"),
    "an if": (Branching(), "with jnp.where and lax.cond in place of if"),
    "numpy's random numbers": (Outside(), "draw all random numbers from the key alone"),
    "another state": (
        stepping(lambda state, after, step: (jnp.append(after, 0.0), step)),
        "a state of other fields, shapes or types",
    ),
    "no end": (
        stepping(lambda state, after, step: (state, step.replace(obs=state, terminated=jnp.array(False)))),
        "no episode ends within 64 steps",
    ),
    "no reset": (
        stepping(lambda state, after, step: (state, step.replace(obs=step.final_obs))),
        "Step.obs is Step.final_obs wherever an episode ends",
    ),
    "a leap": (
        stepping(lambda state, after, step: (after, step.replace(obs=-step.obs)), Chain),
        "Step.obs is not Step.final_obs where an episode goes on",
    ),
    "recall": (other(recall=lambda self, memory: -memory), "recall(remember(state, obs)) is not obs"),
    "recall_next": (
        other(recall_next=lambda self, memory, action, aftermath: memory + aftermath),
        "recall_next(remember(state, obs), action, aftermath) is not Step.final_obs",
    ),
    "neighbours": (altered(reward=lambda step, _: _neighbourly(step.reward)), "steps under vmap differ"),
    "no action": (other(heuristic=lambda self, obs: 2.0 * obs), "what `heuristic` gives is not an action of the space"),
    "features": (
        other(features=lambda self, obs, action: Features(obs, (jnp.broadcast_to(obs, action.shape) * action).sum())),
        "`features` of 8 actions",
    ),
    "own features": (
        other(features=lambda self, obs, action: Features(action.ravel()[:1], action)),
        "`features` hold values in `own` that depend on the action",
    ),
    "aims": (Unequal(), "`aims` have other lengths"),
    "possible aims": (Pointless(), "no aim was possible in any step"),
    "both ends": (altered(truncated=lambda step, _: step.terminated), "is terminated and truncated"),
    "an integer": (altered(reward=lambda step, _: jnp.array(1)), "Step.reward is int32 of shape (): make it float32"),
    "a number for a bool": (altered(terminated=lambda *_: jnp.array(1.0)), "Step.terminated is float32"),
    "not finite": (altered(reward=lambda step, _: step.reward + jnp.inf), "reward is not finite after step"),
    "a name of results": (altered(outcome=lambda step, _: {"finished": step.reward}), "is called ['finished']"),
    "an identity": (mirrored(lambda which, obs, v: (-obs, -v)), "`mirror` 0 is not the identity"),
    "a length": (mirrored(lambda which, obs, v: (obs, v * (1.0 + which))), "`mirror` 1 changes a vector's length"),
    "no sum": (mirrored(lambda which, obs, v: (obs, jnp.where(which, jnp.abs(v), v))), "it must be linear"),
    "no group": (mirrored(lambda which, *both: tuple(rotate(v, which * 1.0) for v in both)), "no symmetry undoes"),
    "a shape": (mirrored(lambda which, obs, v: (obs[:1], v)), "`mirror` changes a shape"),
}
FEW = ("obs_size", "an if", "no reset", "recall", "a number for a bool", "an identity")


@pytest.mark.parametrize("law", long_but(FEW, BROKEN))
def test_a_broken_law_is_told_in_one_line(law):
    env, told = BROKEN[law]
    with pytest.raises(AssertionError) as raised:
        check_environment(env)
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("env", [Aimed(), Window(jnp.float32(0.3), mirrors=True), Chain(jnp.array(True))], ids=str)
def test_the_probes_keep_the_laws(env):
    check_environment(env)


@jax.tree_util.register_pytree_node_class
class Labelled:
    """The bandit in a pytree whose static part follows from a value: each value is another program."""

    def __init__(self, window):
        self.window = window
        self.label = str(getattr(window, "half_width", ""))
        for name in dir(window):  # so that it is an environment to whoever looks at it without asking it
            if not name.startswith("_"):
                setattr(self, name, getattr(window, name))

    def tree_flatten(self):
        return (self.window,), self.label

    @classmethod
    def tree_unflatten(cls, label, children):
        return cls(*children)


def test_values_that_compile_anew_are_found():
    with pytest.raises(AssertionError, match="other values of its floats are traced anew"):
        check_environment(Labelled(Window(jnp.float32(0.5))))
