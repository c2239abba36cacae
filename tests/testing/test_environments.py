"""The laws of environments: kept by the probes and by our own tasks, each broken by one small environment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from probes import Aimed, Chain, Window, long_but

from cuelearner_jax.environment import Features, Quantity, WholeObservations
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import Directions, rotate
from cuelearner_jax.testing import check_environment


def altered(**changes):
    """The bandit with other fields of what its step returns."""

    class Altered(Window):
        def step(self, key, state, action):
            after, step = super().step(key, state, action)
            return after, step.replace(**{name: change(step, after) for name, change in changes.items()})

    return Altered()


class Unnamed(Window):
    observation = (Quantity("context", 3, "1"),)


class Twice(Window):
    observation = (Quantity("context", 1, "1"), Quantity("context", 1, "1"))


class Unitless(Window):
    observation = (Quantity("context", 2, ""),)


class Listed(Window):
    extra: str = "a word"


class Unhashable(Window):
    table: np.ndarray = struct.field(pytree_node=False, default_factory=lambda: np.zeros(2))


class Bare(WholeObservations):
    """No pytree."""

    observation = Window.observation
    reset, step = Window.reset, Window.step


class Branching(Window):
    def step(self, key, state, action):
        return super().step(key, state, -action if action[0] > 0 else action)


class Outside(Window):
    def reset(self, key):
        state, obs = super().reset(key)
        return state, obs * np.random.default_rng().uniform()


class Longer(Window):
    def step(self, key, state, action):
        after, step = super().step(key, state, action)
        return jnp.append(after, 0.0), step


class Endless(Window):
    def step(self, key, state, action):
        _, step = super().step(key, state, action)
        return state, step.replace(obs=state, terminated=jnp.array(False))


class Stale(Window):
    def step(self, key, state, action):
        _, step = super().step(key, state, action)
        return state, step.replace(obs=step.final_obs)


class Leaping(Chain):
    def step(self, key, state, action):
        after, step = super().step(key, state, action)
        return after, step.replace(obs=-step.obs)


class Forgetful(Window):
    def recall(self, memory):
        return -memory


class Late(Window):
    def recall_next(self, memory, action, aftermath):
        return memory + aftermath


class Looking(Window):
    """A step in a batch is another one: its rule looks at the neighbours."""

    def step(self, key, state, action):
        after, step = super().step(key, state, action)
        return after, step.replace(reward=_neighbourly(step.reward))


@jax.custom_batching.custom_vmap
def _neighbourly(reward):
    return reward


@_neighbourly.def_vmap
def _neighbourly_rows(size, batched, rewards):
    return rewards + 1.0, True


class Astray(Window):
    def heuristic(self, obs):
        return 2.0 * obs


class Narrow(Window):
    def features(self, obs, action):
        return Features(obs, (jnp.broadcast_to(obs, action.shape) * action).sum())


class Confused(Window):
    def features(self, obs, action):
        return Features(action.ravel()[:1], action)


class Unequal(Aimed):
    def aims(self, obs):
        return super().aims(obs)._replace(possible=jnp.ones(3, bool))


class Pointless(Aimed):
    possible = (False, False, False, False)


class LongActions(Directions):
    def sample(self, key, shape=()):
        return 2.0 * DIRECTIONS.sample(key, shape)


class FlatActions(Directions):
    def sample(self, key, shape=()):
        return jnp.zeros(shape)


class Loose(Window):
    actions = LongActions()


class Short(Window):
    actions = FlatActions()


def mirrored(image, count=2):
    """The bandit with another `mirror`."""

    class Mirrored(Window):
        symmetries = count

        def mirror(self, which, obs, vector):
            return image(which, obs, vector)

    return Mirrored()


def shifted(which, obs, vector):
    return rotate(obs, which * 1.0), rotate(vector, which * 1.0)


FEW = ("obs_size is 3", "an if", "no reset", "recall", "features", "a number for a bool", "an identity")
BROKEN = {
    "obs_size is 3": (Unnamed(), "has shape (2,): it must have shape (3,), as `observation` says"),
    "a name twice": (Twice(), "two quantities have one name"),
    "no unit": (Unitless(), "lacks a name or a unit"),
    "no array": (Listed(), "field extra is of type str, which is not traced"),
    "no hash": (Unhashable(), "a static field must be hashable"),
    "no pytree": (Bare(), "is not a pytree"),
    "an if": (Branching(), "with jnp.where and lax.cond in place of if"),
    "numpy's random numbers": (Outside(), "draw random numbers from the key alone"),
    "another state": (Longer(), "a state of other fields, shapes or types"),
    "no end": (Endless(), "no episode ends within 64 steps"),
    "no reset": (Stale(), "Step.obs is Step.final_obs wherever an episode ends"),
    "a leap": (Leaping(), "Step.obs is not Step.final_obs where an episode goes on"),
    "recall": (Forgetful(), "recall(remember(state, obs)) is not obs"),
    "recall_next": (Late(), "recall_next(remember(state, obs), action, aftermath) is not Step.final_obs"),
    "neighbours": (Looking(), "steps under vmap differ"),
    "no action": (Astray(), "what `heuristic` gives is not an action of the space"),
    "features": (Narrow(), "`features` of 8 actions"),
    "features of an action": (Confused(), "`features` hold values in `own` that depend on the action"),
    "aims": (Unequal(), "give a row of each, and a bool, for every aim"),
    "possible aims": (Pointless(), "no aim was possible in any step"),
    "sample": (Loose(), "what its actions' `sample` draws is not an action of the space"),
    "shape of samples": (Short(), "`sample` gives shape (3,) for 3 actions of 2"),
    "both ends": (altered(truncated=lambda step, _: step.terminated), "is terminated and truncated"),
    "an integer": (
        altered(reward=lambda step, _: jnp.array(1)),
        "Step.reward is int32 of shape (): make it one float32",
    ),
    "a number for a bool": (altered(terminated=lambda *_: jnp.array(1.0)), "Step.terminated is float32"),
    "not finite": (altered(reward=lambda step, _: step.reward + jnp.inf), "reward is not finite after step 0"),
    "a vector": (altered(metrics=lambda step, _: {"hit": step.obs}), "Step.metrics['hit'] is float32 of shape (2,)"),
    "a name of results": (altered(outcome=lambda step, _: {"finished": step.reward}), "is called ['finished']"),
    "an identity": (mirrored(lambda which, obs, v: (-obs, -v)), "`mirror` 0 is not the identity"),
    "a length": (mirrored(lambda which, obs, v: (obs, v * (1.0 + which))), "`mirror` 1 changes a vector's length"),
    "no sum": (mirrored(lambda which, obs, v: (obs, jnp.where(which, jnp.abs(v), v))), "it must be linear"),
    "no group": (mirrored(shifted), "no symmetry undoes `mirror` 1"),
    "a shape": (mirrored(lambda which, obs, v: (obs[:1], v)), "`mirror` changes a shape"),
}


@pytest.mark.parametrize("law", long_but(FEW, BROKEN))
def test_a_broken_law_is_told_in_one_line(law):
    env, told = BROKEN[law]
    with pytest.raises(AssertionError) as raised:
        check_environment(env)
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "env", [Window(), Aimed(), Window(jnp.float32(0.3), mirrors=True), Chain(), Chain(jnp.array(True))], ids=str
)
def test_the_probes_keep_the_laws(env):
    check_environment(env)


def test_a_short_roll_out_says_that_it_met_no_end():
    with pytest.raises(AssertionError, match="no episode ends within 1 steps: give the check more steps"):
        check_environment(Chain(), steps=1)


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
