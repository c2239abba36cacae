"""Policies, teachers and environments of the user's own that raise or give no actions: named in one line."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import probes
import pytest
from flax import struct

import cuelearner_jax as cl
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.policies import Opaque

TASK = dataclasses.replace(probes.make_task(), presets={})
WORLD = cl.World(TASK, probes.WindowConfig())
TEACHER = cl.teacher_of(WORLD)
SEEN = np.float32([[1, 0], [0, 1], [-1, 0], [0, -1]])
SIZES = GuideSizes(feedback_layers=(8,), fit_steps=20, fit_batch_size=8)
FAULT = {"now": None}


def moody(obs):
    """Acts well on zeros, with which it is tried, and otherwise has the fault of the test."""
    fault = FAULT["now"] if obs.any() else None
    if isinstance(fault, Exception):
        raise fault
    return np.tile([1.0, 0.0] if fault is None else fault, (len(obs), 1))


class Scaled(struct.PyTreeNode):
    """A compiled policy whose actions are good at a scale of 1."""

    scale: float = 1.0

    def act(self, key, states, obs):
        return obs * self.scale

    @property
    def axes(self):
        return self.replace(scale=None)


class Told(struct.PyTreeNode):
    """A teacher that gives what it is told to."""

    given: tuple = (1.0, 0.0)

    def best_action(self, state, obs):
        return jnp.array(self.given)


def adapted(policy, teacher=TEACHER):
    how = {"labels": 10, "sizes": SIZES, "scalars": probes.SCALARS, "judge_episodes": 4, "guidance": "relative"}
    return cl.adapt(policy, WORLD, teacher, **how)


def one_line(call, says):
    with pytest.raises(cl.UserError, match=says) as refused:
        call()
    assert str(refused.value).isprintable()
    return refused.value


FAULTS = {"raised KeyError": KeyError("a\nb"), "gave zero or not finite numbers in place of actions": [np.nan, 0.0]}


@pytest.fixture(params=FAULTS)
def fault(request):
    FAULT["now"] = FAULTS[request.param]
    yield f"policy moody {request.param}"
    FAULT["now"] = None


def test_a_function_on_the_host_is_named_with_what_it_did(fault, caplog):
    policy = cl.CallablePolicy(Opaque(moody, on_host=True))
    for call in (lambda: policy(SEEN), lambda: adapted(moody)):
        assert one_line(call, fault).__cause__ is (FAULT["now"] if isinstance(FAULT["now"], Exception) else None)
    assert not caplog.records  # JAX logs the traceback of a callback that raises
    FAULT["now"] = None
    np.testing.assert_array_equal(policy(SEEN), [[1.0, 0.0]] * 4)  # nothing is left behind


def test_a_compiled_policy_that_gives_no_actions_is_named():
    scale = np.nan
    for call in (lambda: cl.CallablePolicy(Scaled(scale))(SEEN), lambda: adapted(Scaled(scale))):
        one_line(call, "policy Scaled gave actions that are not finite")


def test_a_teacher_that_gives_no_actions_is_named():
    given = (0.0, 0.0)
    one_line(lambda: adapted(Scaled(1.0), Told(given)), "teacher Told gave actions that are not finite")
    train = {"guidance": ["relative"], "labels": [10], "seeds": 1, "progress": False}
    one_line(lambda: cl.train(WORLD, Told(given), probes.CONFIG, **train), "teacher Told gave actions that are not")


def test_another_shape_is_refused_before_anything_is_compiled():
    one_line(lambda: adapted(Scaled(1.0), Told((1.0, 0.0, 0.0))), r"teacher Told gave an action of shape \(3,\)")
    wide = cl.CallablePolicy(Opaque(moody, on_host=True).replace(function=lambda obs: obs[:, :1], on_host=False))
    one_line(lambda: wide(SEEN), r"policy .*lambda.* returned actions of shape \(4, 1\)")
    for odd in (None, [[1j, 0.0]] * 4):
        one_line(lambda odd=odd: cl.CallablePolicy(Opaque(lambda obs: odd, on_host=True))(SEEN), "returned")
