"""Fine-tuning on the bandit: it begins with the bases, turns actions as told, and learns the changed world."""

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from _finetuning import FineTuning, every

from cuelearner_jax import evaluate
from cuelearner_jax.agents.networks import q_network
from cuelearner_jax.policies import Agent

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


def test_a_step_size_of_zero_changes_nothing(tuned):
    tuning, first = tuned
    for now, before in zip(jax.tree.leaves(tuning.block.state.agent.params), jax.tree.leaves(first), strict=True):
        np.testing.assert_array_equal(np.asarray(now)[:4], before[:4])
        assert (np.asarray(now)[4:] != before[4:]).any()


def test_it_learns_where_it_may(tuned):
    policy = tuned[0].policy(probes.Window())
    found = evaluate.rollout_lanes(probes.Window(), policy, evaluate.episodes("tuning"), 40, 80).means["reward"]
    assert found[6:].min() == 1.0  # without noise one of the two has stuck to a direction that misses
    assert found[:4].max() < 1.0
