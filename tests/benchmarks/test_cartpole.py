"""The benchmark's cart and pole are Gymnasium's."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from cartpole import CartPole, CartState

ENV = CartPole()


def test_steps_are_gymnasiums_until_the_pole_falls_or_time_is_up():
    other, step, ends = gymnasium.make("CartPole-v1"), jax.jit(ENV.step), []
    for policy in ("falls", "balances"):
        obs, _ = other.reset(seed=3)
        state = CartState(jnp.asarray(obs), jnp.zeros((), jnp.int32))
        for number in range(500):
            right = policy == "balances" and obs @ np.array([0.1, 0.5, 10.0, 2.0]) > 0
            state = state.replace(obs=jnp.asarray(obs))  # rounding would grow from step to step
            obs, reward, terminated, truncated, _ = other.step(int(right))
            state, found = step(jax.random.key(number), state, jax.nn.one_hot(int(right), 2))
            np.testing.assert_allclose(found.final_obs, obs, atol=1e-6)
            assert (float(found.reward), bool(found.terminated), bool(found.truncated)) == (1.0, terminated, truncated)
            assert reward == 1.0
            if terminated or truncated:
                ends.append((terminated, number + 1))
                assert np.abs(state.obs).max() <= 0.05
                assert int(state.steps) == 0
                break
    assert ends[0][0]
    assert ends[1] == (False, 500)
