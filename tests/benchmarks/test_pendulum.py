"""The benchmark's pendulum is Gymnasium's, and soft actor-critic learns to swing it up."""

import dataclasses

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _measuring import Timed
from pendulum import STEPS, Pendulum, Swing, seen

from cuelearner_jax.agents import sac
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.policies import Agent
from cuelearner_jax.run_config import RunConfig

ENV = Pendulum(jnp.array(STEPS))


def test_steps_are_gymnasiums():
    other = gymnasium.make("Pendulum-v1")
    first, _ = other.reset(seed=3)
    angle, speed = other.unwrapped.state
    state = Swing(jnp.float32(angle), jnp.float32(speed), jnp.zeros((), jnp.int32))
    np.testing.assert_allclose(seen(state), first, atol=1e-6)
    step, random = jax.jit(ENV.step), np.random.default_rng(0)
    for number in range(STEPS):
        torque = random.uniform(-3, 3, 1).astype(np.float32)
        obs, reward, terminated, truncated, _ = other.step(torque)
        state, found = step(jax.random.key(number), state, torque)
        np.testing.assert_allclose(found.final_obs, obs, atol=5e-3)
        assert float(found.reward) == pytest.approx(reward, abs=0.05)
        assert (bool(found.terminated), bool(found.truncated)) == (terminated, truncated)
    assert bool(found.truncated)


AGENT = sac.SACConfig(
    actor_layers=(64, 64),
    critic_layers=(64, 64),
    replay_capacity=10_000,
    batch_size=128,
    actor_rate=1e-3,
    critic_rate=1e-3,
    temperature_rate=1e-3,
)
REDQ = {"critics": 4, "layer_norm": True, "updates_per_step": 4, "batch_size": 64}


@pytest.mark.long
@pytest.mark.parametrize(("changes", "steps"), [({}, 5_000), (REDQ, 3_000)], ids=["two critics", "four, normalised"])
def test_soft_actor_critic_swings_it_up(changes, steps):
    """A random policy earns about -1,200 an episode, one that holds the pole up about -150."""
    config = RunConfig(
        None,
        Sizes(num_envs=1),
        Scalars(discount=0.99, max_grad_norm=1e6),
        Schedule(random_steps=500, learn_after=500, guidance_until=0),
        dataclasses.replace(AGENT, **changes),
    )
    timed = Timed(config, ENV, "none", 2)
    timed.train(steps)
    functions = config.agent_in(ENV)
    policy = lambda lane: Agent(lane.agent.params, functions)  # noqa: E731
    found = timed.group.evaluate(policy, ENV, jax.random.key(5), 20, 20 * STEPS, timed.blocks)
    assert (STEPS * found["reward"] > -300).all()
