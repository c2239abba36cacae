"""Fine-tuning on the bandit: it begins with the bases, turns actions as told, and learns the changed world."""

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from _finetuning import FineTuning, every

from cuelearner_jax import evaluate
from cuelearner_jax.agents.networks import q_network
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Agent
from cuelearner_jax.spaces import directions

CONFIG = probes.config(schedule={"learn_after": 32, "total_steps": 4800})
STEPS, NOISE_DEG = 400, 10.0
pytestmark = pytest.mark.long  # a baseline of the experiments alone, which trains eight lanes


@pytest.fixture(scope="module")
def agents():
    """Two agents that know nothing."""
    init = q_network(CONFIG.agent.q_layers).init
    keys = jax.random.split(jax.random.key(5), 2)
    return Agent(jax.vmap(lambda key: init(key, jnp.zeros(2), jnp.zeros(2)))(keys), probes.FUNCTIONS)


@pytest.fixture(scope="module")
def tuned(agents):
    """Each with every setting for some steps: lanes 0 to 3 learn nothing."""
    lanes = every(bases=2, seeds=(3,), learning_rates=(0.0, 3e-3), noises_deg=(0.0, NOISE_DEG))
    tuning = FineTuning(CONFIG, probes.Window(), agents, lanes)
    first = jax.tree.map(np.asarray, tuning.block.state.agent.params)
    for _ in range(3):
        rewards = tuning.train(STEPS)
    assert tuning.step == 3 * STEPS
    assert rewards.shape == (8,)
    return tuning, first


def test_lanes_have_every_setting_and_begin_as_their_bases(tuned, agents):
    tuning, first = tuned
    lanes = tuning.lanes
    assert lanes.base.tolist() == [0, 1] * 4
    np.testing.assert_allclose(lanes.learning_rate, [0] * 4 + [3e-3] * 4)
    assert lanes.noise_deg.tolist() == [0, 0, NOISE_DEG, NOISE_DEG] * 2
    jax.tree.map(
        lambda lane, base: np.testing.assert_array_equal(lane, np.asarray(base)[lanes.base]), first, agents.params
    )
    assert not tuning.failed.any()


def test_a_step_size_of_zero_changes_nothing(tuned):
    tuning, first = tuned
    for now, before in zip(jax.tree.leaves(tuning.block.state.agent.params), jax.tree.leaves(first), strict=True):
        np.testing.assert_array_equal(np.asarray(now)[:4], before[:4])
        assert (np.asarray(now)[4:] != before[4:]).any()


def test_actions_are_turned_by_the_noise_and_no_step_is_uniform(tuned, agents):
    for lane, base in ((0, 0), (1, 1), (2, 0), (3, 1)):  # which act as their base throughout
        stored = probes.stored(tuned[0].block.state, lane, 3 * STEPS)
        one = Agent(jax.tree.map(lambda leaf, n=base: leaf[n], agents.params), probes.FUNCTIONS)
        greedy = one.act(jax.random.key(0), None, jnp.asarray(stored["obs"]))
        turns = np.rad2deg(directions.difference(greedy, jnp.asarray(stored["action"])))
        if lane < 2:
            np.testing.assert_array_equal(stored["action"], greedy)
        else:
            assert turns.std() == pytest.approx(NOISE_DEG, rel=0.1)
            assert abs(turns.mean()) < 1.0


def test_it_learns_where_it_may(tuned):
    policy = tuned[0].policy(probes.Window())
    found = evaluate.rollout_lanes(probes.Window(), policy, evaluate.episodes("tuning"), 40, 80).means["reward"]
    assert found[6:].min() == 1.0  # without noise one of the two has stuck to a direction that misses
    assert found[:4].max() < 1.0


def test_what_cannot_be_is_refused(agents):
    lanes = every(bases=2, seeds=(3,), learning_rates=(-1.0,), noises_deg=(0.0,))
    with pytest.raises(UserError, match="must not be negative"):
        FineTuning(CONFIG, probes.Window(), agents, lanes)


def test_steps_come_in_whole_rounds_of_the_environments(tuned):
    with pytest.raises(UserError, match=r"give a multiple of sizes.num_envs \(4\)"):
        tuned[0].train(6)
