"""Roll-outs: means over whole first episodes or none at all, and the same numbers in one stretch or in many."""

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import evaluate
from cuelearner_jax.devices import Portions, lane_mesh
from cuelearner_jax.policies import Agent, Uniform

LONGEST = 4
KEY = jax.random.key(7)


class Fuse(probes.Window):
    """The bandit, until a fuse of 1 to `LONGEST` steps has burnt; long ones fail."""

    def reset(self, key):
        obs, _ = super().reset(key)
        return (obs, jax.random.randint(key, (), 1, LONGEST + 1), jnp.zeros((), jnp.int32)), obs

    def step(self, key, state, action):
        obs, fuse, burnt = state
        _, step = super().step(key, obs, action)
        ends = burnt + 1 >= fuse
        fresh, fresh_obs = self.reset(key)
        after = jax.tree.map(lambda new, old: jnp.where(ends, new, old), fresh, (obs, fuse, burnt + 1))
        outcome = {"success": jnp.where(fuse < LONGEST, 1.0, 0.0), "duration": burnt + 1.0}
        return after, step.replace(obs=jnp.where(ends, fresh_obs, obs), terminated=ends, outcome=outcome)


ENV = Fuse()


def rolled(num_envs, steps, env=ENV):
    return jax.device_get(evaluate.evaluate_policy(env, Uniform(), KEY, num_envs, num_envs * steps))


@pytest.mark.parametrize(("count", "groups"), [(100, 20), (32, 16), (10, 10), (7, 7), (23, 20)])
def test_episodes_are_kept_as_means_of_groups(count, groups):
    means = evaluate.group_means(np.arange(float(count))[None])
    assert means.shape == (1, groups)
    assert means.mean() == pytest.approx((count - 1) / 2)


def test_means_over_first_episodes_are_of_all_of_them_or_of_none():
    whole = rolled(400, LONGEST)
    assert whole["finished"] == 1
    assert whole["success"] == pytest.approx(1 - 1 / LONGEST, abs=0.07)
    cut = rolled(400, LONGEST - 1)
    assert cut["finished"] == pytest.approx(1 - 1 / LONGEST, abs=0.07)
    assert np.isnan([cut["success"], cut["duration"]]).all()  # 1.0 over the short ones would be wrong
    assert np.isfinite([cut["reward"], cut["hit"]]).all()


@pytest.mark.parametrize("steps", [1, 6])
def test_a_roll_out_in_stretches_is_bitwise_that_in_one(steps):
    told = []
    watched = evaluate.rollout_with_progress(ENV, Uniform(), KEY, 20, 20 * steps, lambda *given: told.append(given))
    whole = rolled(20, steps)
    assert watched.means.keys() == whole.keys()
    for name, value in whole.items():
        np.testing.assert_array_equal(watched.means[name], value, strict=True)
    assert told == [(done, told[-1][1]) for done in range(told[-1][1] + 1)]
    assert told[-1][1] == {1: 1, 6: 3}[steps]  # none of a single step


@pytest.mark.parametrize("at_once", [2, *(pytest.param(number, marks=pytest.mark.long) for number in (1, 16))])
def test_lanes_in_stretches_are_bitwise_those_in_one(monkeypatch, at_once):
    """Three lanes, one, two or all at a time."""
    monkeypatch.setattr(evaluate, "portions", lambda: Portions(actions=8192, agents=at_once, states=16, passes=1))
    agents = Agent(probes.start(probes.window_program("none"), [0, 1, 2], [0, 0, 0]).agent.params, probes.FUNCTIONS)
    told = []
    watched = evaluate.rollout_lanes(ENV, agents, KEY, 10, 120, lambda *given: told.append(given))
    whole = evaluate.rollout_lanes(ENV, agents, KEY, 10, 120, mesh=lane_mesh(jax.local_devices()[:1])).means
    for name, value in whole.items():
        np.testing.assert_array_equal(watched.means[name], value, strict=True)
    assert len(set(watched.means["reward"])) > 1
    assert watched.each["reward"].shape == (3, 10)
    batches = -(-3 // at_once)
    assert told[0] == (0, 6 * batches)
    assert told[-1] == (6 * batches, 6 * batches)
    evaluate._on_mesh.clear_cache()  # it has seen other portions than the device's
