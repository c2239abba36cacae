"""The laws of policies: kept by our own, each broken by one small policy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from probes import Expert, Window

from cuelearner_jax.policies import SHARED, Heuristic, Opaque, Taught, Teaching, Uniform
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import retract
from cuelearner_jax.testing import check_policy

ENV = Window()
OWN = {
    "chance": Uniform(),
    "a teacher": Taught(Expert(ENV)),
    "a heuristic": Heuristic(ENV),
    "a function": Opaque(lambda obs: -obs),
    "a function on the host": Opaque(np.negative, on_host=True),
    "a policy as a teacher": Taught(Teaching(Heuristic(ENV))),
}


class Turned(struct.PyTreeNode):
    """The observation as an action, turned upside down by a parameter."""

    sign: float = -1.0

    def act(self, key, states, obs):
        return self.chosen(key, states, retract(self.sign * obs))

    def chosen(self, key, states, actions):
        return actions

    @property
    def axes(self):
        return self.replace(sign=SHARED)


def altered(change):
    """`Turned` with its actions changed."""

    class Altered(Turned):
        def chosen(self, key, states, actions):
            return change(key, actions)

    return Altered()


class Sideways(Turned):
    @property
    def axes(self):
        return self.replace(sign=1)


class Branching(Turned):
    def chosen(self, key, states, actions):
        return actions if self.sign > 0 else -actions


class Bare:
    """No pytree."""

    axes = None
    act = Turned.act


BROKEN = {
    "no pytree": (Bare(), "the policy is not a pytree"),
    "other axes": (Sideways(), "`axes` holds something else than BY_LANE and SHARED"),
    "an if": (Branching(), "`act` under jit fails"),
    "a length": (altered(lambda key, actions: 2.0 * actions), "is not an action of the space"),
    "one for all": (altered(lambda key, actions: actions[0]), "`act` returns shape (2,) for 9 observations"),
    "neighbours": (altered(lambda key, actions: retract(actions + actions[:1])), "depends on the others"),
    "not finite": (altered(lambda key, actions: actions / 0.0), "is not finite everywhere"),
}


@pytest.mark.parametrize("law", BROKEN)
def test_a_broken_law_is_told_in_one_line(law):
    policy, told = BROKEN[law]
    with pytest.raises(AssertionError) as raised:
        check_policy(policy, ENV)
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", OWN)
def test_our_own_keep_the_laws(name):
    check_policy(OWN[name], ENV)


def test_a_policy_of_ones_own_keeps_them():
    check_policy(Turned(), ENV)
    check_policy(Turned(jnp.float32(1.0)), ENV)


def test_drawn_actions_need_not_keep_their_rows():
    check_policy(altered(lambda key, actions: DIRECTIONS.sample(key, (len(actions),))), ENV)


def test_hidden_random_numbers_are_found():
    drawn = np.random.default_rng(0)

    def noisy(key, actions):
        shape = jax.ShapeDtypeStruct(actions.shape, jnp.float32)
        noise = jax.pure_callback(lambda: drawn.normal(size=actions.shape).astype(np.float32), shape)
        return retract(actions + noise)

    with pytest.raises(AssertionError, match="the same key gives other actions"):
        check_policy(altered(noisy), ENV)
