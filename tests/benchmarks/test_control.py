"""The benchmarks' classic control tasks are Gymnasium's, and soft actor-critic learns to swing the pendulum up."""

import dataclasses
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _comparing import evaluation
from _measuring import Timed
from classic_control import TASKS, Episode

import cuelearner_jax as cl
from cuelearner_jax.agents import sac
from cuelearner_jax.bridges.gymnasium.pool import pool_of
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.run_config import RunConfig

PENDULUM = TASKS["Pendulum-v1"]


class UnlikeUnits(type(PENDULUM)):
    """The pendulum, with observations in units that are a million apart."""

    def observe(self, state):
        return super().observe(state) * jnp.array([1e3, 1e-3, 1.0]) + jnp.array([500.0, 0.0, 0.0])


CASES = {  # policy of the second episode, in the first the action is 0; steps of both, and whether time ended them
    "CartPole-v1": (lambda obs: int(obs @ np.array([0.1, 0.5, 10.0, 2.0]) > 0), [(9, False), (500, True)]),
    "MountainCar-v0": (lambda obs: 2 * int(obs[1] > 0), [(200, True), (153, False)]),
    "Acrobot-v1": (lambda obs: 2 * int(obs[5] > 0), [(500, True), (82, False)]),
    "Pendulum-v1": (lambda obs: 6 * obs[1:2], [(200, True), (200, True)]),
}


@pytest.mark.parametrize("name", CASES)
def test_starts_and_steps_are_gymnasiums(name):
    (second, ends), env, other, lengths = CASES[name], TASKS[name], gymnasium.make(name), []
    starts = np.array([other.reset(seed=seed) and other.unwrapped.state for seed in range(300)])
    ours = np.asarray(jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 300))[0].state)
    for end in (np.min, np.max):
        assert (np.abs(end(ours, 0) - end(starts, 0)) <= 0.05 * np.ptp(starts, 0) + 1e-6).all()
    is_box, step = isinstance(other.action_space, gymnasium.spaces.Box), jax.jit(env.step)
    for policy in (lambda _: np.zeros(1, np.float32) if is_box else 0, second):
        obs, _ = other.reset(seed=3)
        for number in range(500):
            action = policy(obs)
            state = Episode(np.float32(other.unwrapped.state), jnp.int32(number))
            obs, reward, terminated, truncated, _ = other.step(action)
            state, ours = step(jax.random.key(number), state, action if is_box else np.eye(3)[action])
            np.testing.assert_allclose(ours.final_obs, obs, atol=1e-5)
            assert float(ours.reward) == pytest.approx(reward, abs=1e-4)
            assert (bool(ours.terminated), bool(ours.truncated)) == (terminated, truncated)
            assert int(state.steps) == (0 if terminated or truncated else number + 1)
            if terminated or truncated:
                lengths.append((number + 1, truncated))
                break
    assert lengths == ends


RATES = dict.fromkeys(("actor_rate", "critic_rate", "temperature_rate"), 1e-3)
AGENT = sac.SACConfig((64, 64), (64, 64), replay_capacity=10_000, batch_size=128, **RATES)
REDQ = {"critics": 4, "layer_norm": True, "updates_per_step": 4, "batch_size": 64}


@pytest.mark.long
@pytest.mark.parametrize(
    ("env", "changes", "steps"),
    [
        (PENDULUM, {}, 5_000),
        (PENDULUM, REDQ, 3_000),
        (PENDULUM, {"bins": True}, 5_000),
        (UnlikeUnits(), {"normalise_obs": True}, 7_000),  # without, it earns about -1,500
    ],
)
def test_soft_actor_critic_swings_it_up(env, changes, steps):
    """A random policy earns about -1,200 an episode, one that holds the pole up about -150."""
    schedule = Schedule(random_steps=500, learn_after=500, guidance_until=0)
    scalars = Scalars(discount=0.99, max_grad_norm=1e6)
    config = RunConfig(None, Sizes(num_envs=1), scalars, schedule, dataclasses.replace(AGENT, **changes))
    timed = Timed(config, env, "none", 2)
    timed.train(steps)
    returned = evaluation(env, config.agent_in(env))
    assert all((returned(block.agent.params) > -300).all() for block in timed.blocks)


def test_no_episode_is_played_again_while_a_longer_one_goes_on():
    env, gains = cl.from_gymnasium("CartPole-v1", processes=1).env, jnp.array([0.1, 0.5, 10.0, 2.0])
    act = lambda env, balances, obs, key: jnp.eye(2)[((obs @ gains > 0) & balances).astype(int)]  # noqa: E731
    falls, balances = evaluation(env, SimpleNamespace(act=act))(jnp.array([False, True]))
    assert falls < 15 < balances == 500
    assert pool_of(env.source).hosts[0].instances.replays == 0
