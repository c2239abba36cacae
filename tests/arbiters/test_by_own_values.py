"""Beside an agent with an actor its own critics compare: while acting, in targets, and in the finished policy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
import walk_task
from walk_task import BOX, SMALL, Walk

from cuelearner_jax.arbiters import by_value
from cuelearner_jax.arbiters.protocol import Chooses, Finishes, HasCritic, InTargets, LaneParts, make_arbiter, offer_of
from cuelearner_jax.guides import registry

ENV = Walk()
OBS = jnp.stack([jnp.linspace(-1, 1, 9), jnp.zeros(9)], -1)
BASE = BOX.sample(jax.random.key(1), (9,))
OPTIONS = by_value.Config()
HEURISTIC, NONE = (registry.make(kind, probes.SIZES, ENV) for kind in ("heuristic", "none"))
GUIDED = np.asarray(jax.jit(jax.vmap(ENV.heuristic))(OBS))


class Fond:
    """An agent whose values are the first entries of actions, times its parameters, and which does `BASE`."""

    def value(self, env, params, obs, actions):
        return params * actions[..., 0]

    def act(self, env, params, obs, key):
        return BASE


def made(options=OPTIONS, agent=SMALL, bootstraps=True):
    return make_arbiter(options, agent, bootstraps)


def known(taste=1.0, guide=HEURISTIC):
    model = guide.init(jax.random.key(0))
    return LaneParts(ENV, Fond(), jnp.float32(taste), guide, model, probes.SCALARS, jnp.float32(0))


@pytest.mark.parametrize("taste", [1.0, -1.0])
def test_the_guides_action_is_executed_where_the_agents_own_critics_prefer_it(taste):
    arbiter = made()
    state = by_value.ComparingState(jnp.ones(9, bool), best=jnp.int32(0))
    found = arbiter.choose(state, OPTIONS, known(taste), OBS, BASE, jnp.array(True), jax.random.key(0))
    prefers = taste * (GUIDED[:, 0] - np.asarray(BASE)[:, 0]) > 0
    assert 0 < prefers.sum() < 9
    np.testing.assert_allclose(found.actions, np.where(prefers[:, None], GUIDED, BASE))
    np.testing.assert_array_equal(found.passes, prefers.astype(int))
    early = arbiter.choose(state, OPTIONS, known(taste), OBS, BASE, jnp.array(False), jax.random.key(0))
    np.testing.assert_array_equal(early.actions, BASE)


def test_the_finished_policy_is_the_arm_that_validated_best():
    arbiter = made()
    assert arbiter.arms == ("own", "better")
    state = arbiter.init(4)
    assert int(arbiter.arm(state)) == by_value.OWN
    assert int(arbiter.arm(arbiter.with_arm(state, jnp.int32(1)))) == by_value.BETTER
    own, better = (arbiter.act(jnp.int32(arm), OPTIONS, known(), OBS, jax.random.key(0)) for arm in (0, 1))
    np.testing.assert_array_equal(own, BASE)
    np.testing.assert_allclose(better[:, 0], np.maximum(GUIDED[:, 0], BASE[:, 0]))


def test_the_agent_and_the_options_decide_what_the_arbiter_does():
    plain = made(agent=probes.AGENT)
    assert isinstance(plain, HasCritic)  # a second critic, and nothing else: the agent takes the argmax
    assert not isinstance(plain, Finishes | InTargets)
    for in_policy in (True, False):
        arbiter = made(dataclasses.replace(OPTIONS, in_policy=in_policy))
        assert isinstance(arbiter, Chooses)
        assert isinstance(arbiter, InTargets)
        assert isinstance(arbiter, Finishes) == in_policy
        assert not isinstance(arbiter, HasCritic)
    assert made().in_targets
    assert not made(dataclasses.replace(OPTIONS, in_targets=False)).in_targets
    assert not made(bootstraps=False).in_targets
    assert made() == made()


def test_targets_are_offered_the_guides_actions_in_its_time():
    def offer(arbiter, guide=HEURISTIC, counts=True):
        where = (guide.init(jax.random.key(0)), ENV, probes.SCALARS, jnp.array(counts))
        return offer_of(arbiter, guide, *where)

    np.testing.assert_allclose(offer(made())(OBS, BASE), GUIDED)
    np.testing.assert_array_equal(offer(made(), counts=False)(OBS, BASE), BASE)
    assert offer(made(), guide=NONE) is None
    assert offer(made(dataclasses.replace(OPTIONS, in_targets=False))) is None
    assert offer(made(agent=probes.AGENT)) is None


@pytest.mark.long
def test_a_guide_that_knows_is_followed_and_one_that_errs_is_not():
    schedule = {"random_steps": 200, "learn_after": 100, "guidance_until": 10**6}
    sizes = {"num_envs": 1}
    agent = dataclasses.replace(SMALL, actor_layers=(32,), critic_layers=(32, 32), batch_size=64, replay_capacity=4000)
    config = walk_task.config(agent, by_value.Config(), sizes=sizes, schedule=schedule)
    shares = []
    for wrong in (0.0, 2.0):
        env = Walk(jnp.float32(wrong))
        program = walk_task.program(config, "heuristic", env)
        state = probes.start(program, [0], [0], env)
        clock, state, _ = program.train(env, config.settings, walk_task.start_clock(), state, 1500)
        _, _, metrics = program.train(env, config.settings, clock, state, 1500)
        shares.append(float(metrics["guided_share"][0]))
    assert shares[0] > 0.5 > shares[1] + 0.2
