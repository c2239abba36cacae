"""Policies on the bandit, whose best direction is known; and blocks of them, a lane of which is itself."""

import dataclasses
import json
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.agents.networks import q_network
from cuelearner_jax.config import Scalars
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.environment import Aims
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import evaluate_policy, rollout_lanes
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.policies import (
    Agent,
    Common,
    Corrected,
    Guided,
    NearAims,
    Opaque,
    Taught,
    Teaching,
    Uniform,
    describe,
    layers,
    policy_of,
)
from cuelearner_jax.spaces import DIRECTIONS, directions

ENV, EXPERT = probes.Window(), probes.Expert(probes.Window())
OBS = directions.evenly_spaced(40)
BEST = jax.jit(directions.rotate)(OBS, 0.6)
KEY = jax.random.key(5)
Q = q_network(probes.AGENT.q_layers)
AGENT = Agent(jax.jit(Q.init)(jax.random.key(1), jnp.zeros(2), jnp.zeros(2)), probes.FUNCTIONS)
LANES, MESH = 4, lane_mesh()


def act(policy, key=KEY, obs=OBS):
    return np.asarray(policy.act(key, obs, obs))


# What each does.


class Aiming:
    """Two aims, a quarter turn to each side of what is seen; none where that points down."""

    def aims(self, obs):
        both = jnp.stack([directions.rotate(obs, turn) for turn in (jnp.pi / 2, -jnp.pi / 2)])
        return Aims(both, jnp.zeros((2, 1)), jnp.full(2, obs[1] >= 0))


def test_actions_near_aims_are_near_each_of_them_and_anywhere_where_there_is_none():
    turns = np.degrees(directions.difference(OBS, act(NearAims(Aiming(), 0.1))))
    here = np.asarray(OBS[:, 1] >= 0)
    assert 1.0 < np.abs(np.abs(turns[here]) - 90.0).max() <= np.degrees(0.1) + 1e-3
    assert {*np.sign(turns[here])} == {-1.0, 1.0}
    assert np.abs(np.abs(turns[~here]) - 90.0).max() > 30.0


def test_under_relative_guidance_every_action_is_refined_once_the_model_is_fitted():
    relative = guidances.make("relative", probes.SIZES, ENV)
    model = relative.init(KEY)
    guided = Guided(AGENT, model, ENV, probes.SCALARS, relative)
    np.testing.assert_array_equal(act(guided), act(AGENT))
    model = model.replace(fitted=jnp.array(True))
    refined = relative.act(model, ENV, OBS, AGENT.act(KEY, OBS, OBS), jnp.ones(len(OBS), bool), probes.SCALARS)
    np.testing.assert_array_equal(act(guided.replace(model=model)), refined.actions)
    assert np.abs(act(guided) - np.asarray(refined.actions)).max(-1).min() > 0


def test_corrections_end_within_half_eps_of_the_teachers_best():
    base, eps_deg = AGENT, 5.0
    scalars = dataclasses.replace(probes.SCALARS, eps_deg=eps_deg)
    error = np.rad2deg(np.abs(directions.difference(BEST, act(Corrected(base, EXPERT, scalars)))))
    assert error.max() <= eps_deg / 2 + 1e-2
    assert np.rad2deg(np.abs(directions.difference(BEST, act(base)))).max() > eps_deg


class TwoShots:
    """Its best shot lies 90 degrees to the left of the observation, another good one 10 degrees to the right."""

    def best_action(self, state, obs):
        return directions.rotate(obs, jnp.pi / 2)

    def nearest_good(self, state, obs, action, spread, share):
        near = directions.rotate(obs, jnp.deg2rad(-10.0))
        closer = DIRECTIONS.distance(action, near) < DIRECTIONS.distance(action, self.best_action(state, obs))
        return jnp.where(closer, near, self.best_action(state, obs))


@pytest.mark.parametrize(("bound_deg", "turned_deg"), [(60, -10), (6, -6)])
def test_a_teacher_corrects_toward_what_it_has_in_mind_within_the_bound(bound_deg, turned_deg):
    scalars = Scalars(answer="nearest", eps_deg=2.0, tau_deg=0.1, tau_max_deg=float(bound_deg), k_max=50)
    done = act(Corrected(Opaque(lambda obs: obs), TwoShots(), scalars))
    np.testing.assert_allclose(np.rad2deg(directions.difference(OBS, done)), turned_deg, atol=1.0)


# Functions of one's own.


def turned(obs):
    """A function of JAX or NumPy arrays, not of unit length: the observation turned, and an eighth stretched."""
    x, y = obs[..., 0], obs[..., 1]
    cos, sin = np.float32(np.cos(0.5)), np.float32(np.sin(0.5))
    return 2.5 * (jnp if isinstance(obs, jax.Array) else np).stack([cos * x - sin * y, sin * x + cos * y], -1)


OPAQUE = {"in JAX": Opaque(turned), "on the host": Opaque(turned, on_host=True)}


@pytest.mark.parametrize("name", OPAQUE)
def test_a_function_is_called_whatever_surrounds_it(name):
    policy = OPAQUE[name]
    called = turned(np.asarray(OBS))
    direct = called / np.linalg.norm(called, axis=-1, keepdims=True)
    np.testing.assert_allclose(direct, directions.rotate(OBS, 0.5), atol=1e-6)
    np.testing.assert_allclose(act(policy), direct, atol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda policy, obs: policy.act(KEY, obs, obs))(policy, OBS), direct, atol=1e-6)
    lanes = OBS.reshape(4, 10, 2)
    many = jax.jit(jax.vmap(lambda obs: policy.act(KEY, obs, obs)))
    np.testing.assert_allclose(many(lanes), direct.reshape(4, 10, 2), atol=1e-6)


def stacked():
    """A policy with a memory: the difference to the observation before, the first time the observation itself."""
    before = []

    def differences(obs):
        before.append(obs)
        return obs - before[-2][:1] if len(before) > 1 else obs

    return differences


@pytest.mark.parametrize(
    ("function", "why"),
    [
        (lambda obs: obs + np.random.normal(size=obs.shape), "another action when it is asked again"),
        (stacked(), "another action when it is asked again"),
        (lambda obs: obs - 0.1 * obs.mean(0), "another action in a batch of 32"),
        (lambda obs: (obs, obs), "gives a state beside its actions"),
    ],
)
def test_a_policy_that_does_not_repeat_itself_is_refused(function, why):
    with pytest.raises(UserError, match=why):
        act(Opaque(function, on_host=True))


def test_a_function_of_more_than_observations_is_refused_with_the_call_that_would_do():
    def policy(obs, key):  # as brax makes it
        return obs, {"key": key}

    for given in (policy, jax.jit(policy)):
        with pytest.raises(UserError, match=r"takes obs, key: give .* jax.jit\(lambda obs: policy\(obs, key\)\[0\]"):
            policy_of(given)


# Teachers.


def test_a_finished_agent_teaches_what_it_does():
    teacher = Teaching(AGENT)
    expected = act(AGENT)
    np.testing.assert_array_equal(np.stack([teacher.best_action(state, state) for state in OBS[:5]]), expected[:5])
    np.testing.assert_array_equal(act(Taught(teacher)), expected)
    # A policy that looks at the state sees it.
    np.testing.assert_allclose(act(Taught(Teaching(Taught(EXPERT)))), BEST, atol=1e-6)
    corrected = act(Corrected(Uniform(), teacher, probes.SCALARS))
    assert np.rad2deg(np.abs(directions.difference(expected, corrected))).max() <= probes.SCALARS.eps_deg / 2 + 1e-2


# Blocks of lanes.


@cache
def block():
    """Four lanes of one program, each with its own network and its own fitted model."""
    program = probes.window_program("relative")
    state = probes.start(program, [0, 1, 2, 3], [10] * LANES)
    _, state = program.label_round(ENV, EXPERT, probes.SCALARS, start_clock(), state)
    return state


def guided(base):
    return Guided(base, block().guide.model, ENV, probes.SCALARS, guidances.make("relative", probes.SIZES, ENV))


def agents():
    return Agent(block().agent.params, probes.FUNCTIONS)


BLOCKS = {
    "agent": agents,
    "guided agent": lambda: guided(agents()).replace(bound=jnp.array(0.2)),
    "corrected agent": lambda: Corrected(agents(), EXPERT, dataclasses.replace(probes.SCALARS, tau_max_deg=60.0)),
}


@pytest.mark.parametrize("name", probes.long_but(("agent", "guided agent"), BLOCKS))
def test_a_block_is_evaluated_as_each_of_its_lanes(name):
    policy = BLOCKS[name]()
    together = rollout_lanes(ENV, policy, KEY, 20, 400, mesh=MESH).means
    alone = [evaluate_policy(ENV, policy.lane(lane), KEY, 20, 400) for lane in range(LANES)]
    assert together.keys() == alone[0].keys()
    for metric, values in together.items():
        assert values.shape == (LANES,)
        np.testing.assert_allclose(values, [found[metric] for found in alone], atol=1e-6)
    assert len(set(np.asarray(together["reward"]).tolist())) > 1  # lanes differ


def test_every_policy_says_what_it_is():
    told = guided(Common(agents())).describe()
    assert [layer["policy"] for layer in layers(told)] == ["guided", "agent"]
    assert (told["guidance"], told["bounded"]) == ("relative", False)
    assert told["base"]["agent"]["q_layers"] == [32, 32]
    assert json.loads(json.dumps(told)) == told
    asking = Corrected(Taught(EXPERT), EXPERT, probes.SCALARS)
    assert [layer["asks"] for layer in layers(asking.describe())] == [True, True]
    assert describe(Opaque(np.sin)) == {"policy": "code", "named": "sin"}
    assert describe(EXPERT) == {"policy": "code", "named": "Expert"}
