"""The benchmarks' pendulum and cart are Gymnasium's, and soft actor-critic learns to swing the pendulum up."""

import dataclasses

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _comparing import evaluation
from _measuring import Timed
from cartpole import CartPole, CartState
from pendulum import STEPS, Pendulum, Swing

from cuelearner_jax.agents import sac
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.run_config import RunConfig

ENV = Pendulum(jnp.array(STEPS))


def cart_push(obs, number):
    """Push so that the pole falls in the first episode, and stays up in the second."""
    return int(number >= 500 and obs @ np.array([0.1, 0.5, 10.0, 2.0]) > 0)


@pytest.mark.parametrize(
    ("name", "env", "state_at", "action_at", "as_ours"),
    [
        ("Pendulum-v1", ENV, lambda s, n: Swing(*s, n), lambda _, n: np.array([6 * np.sin(n)], np.float32), np.array),
        ("CartPole-v1", CartPole(), CartState, cart_push, lambda push: np.eye(2)[push]),
    ],
)
def test_steps_are_gymnasiums(name, env, state_at, action_at, as_ours):
    other, step, lengths = gymnasium.make(name), jax.jit(env.step), []
    for episode in (0, 1):
        obs, _ = other.reset(seed=3)
        for number in range(500):
            action = action_at(obs, 500 * episode + number)
            state = state_at(np.float32(other.unwrapped.state), jnp.int32(number))
            obs, reward, terminated, truncated, _ = other.step(action)
            state, ours = step(jax.random.key(number), state, as_ours(action))
            np.testing.assert_allclose(ours.final_obs, obs, atol=1e-5)
            assert float(ours.reward) == pytest.approx(reward, abs=1e-4)
            assert (bool(ours.terminated), bool(ours.truncated)) == (terminated, truncated)
            assert int(state.steps) == (0 if terminated or truncated else number + 1)
            if terminated or truncated:
                lengths.append((number + 1, truncated))
                break
    assert lengths in ([(200, True), (200, True)], [(9, False), (500, True)])


RATES = dict.fromkeys(("actor_rate", "critic_rate", "temperature_rate"), 1e-3)
AGENT = sac.SACConfig((64, 64), (64, 64), replay_capacity=10_000, batch_size=128, **RATES)
REDQ = {"critics": 4, "layer_norm": True, "updates_per_step": 4, "batch_size": 64}


@pytest.mark.long
@pytest.mark.parametrize(("changes", "steps"), [({}, 5_000), (REDQ, 3_000)], ids=["two critics", "four, normalised"])
def test_soft_actor_critic_swings_it_up(changes, steps):
    """A random policy earns about -1,200 an episode, one that holds the pole up about -150."""
    schedule = Schedule(random_steps=500, learn_after=500, guidance_until=0)
    scalars = Scalars(discount=0.99, max_grad_norm=1e6)
    config = RunConfig(None, Sizes(num_envs=1), scalars, schedule, dataclasses.replace(AGENT, **changes))
    timed = Timed(config, ENV, "none", 2)
    timed.train(steps)
    returned = evaluation(ENV, config.agent_in(ENV))
    assert all((returned(block.agent.params) > -300).all() for block in timed.blocks)
