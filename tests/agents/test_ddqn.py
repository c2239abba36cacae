"""Double DQN: targets, loss, clipping and averaging with numbers worked out by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.agents import ddqn
from cuelearner_jax.agents.replay import Transition
from cuelearner_jax.environment import spaces_of

OPTIONS = ddqn.DDQNConfig(q_layers=(2,), directions=4, target_directions=4)  # east, north, west, south
AGENT = OPTIONS.make("raw", spaces_of(probes.Window()), bootstraps=True)


def linear(east, north):
    """Parameters of a network whose value is east * max(a_x, 0) + north * max(a_y, 0), whatever the observation."""
    first = jnp.concatenate([jnp.zeros((2, 2)), jnp.eye(2)])
    last = {"kernel": jnp.array([[east], [north]]), "bias": jnp.zeros(1)}
    return {"params": {"Dense_0": {"kernel": first, "bias": jnp.zeros(2)}, "Dense_1": last}}


ONLINE, TARGET = linear(1.0, 0.5), linear(0.2, 5.0)  # online prefers east, target north


def targets(discount, agent=AGENT):
    """Of two steps that earned 1, of which the second ended the episode."""
    batch = Transition(jnp.ones((2, 2)), jnp.ones((2, 2)), jnp.ones(2), jnp.array([1.0, 0.0]), jnp.ones((2, 2)))
    return agent.targets(None, OPTIONS, discount, ONLINE, TARGET, [batch])


def test_a_finished_agent_takes_the_argmax_over_its_directions():
    for params, best in ((ONLINE, [1, 0]), (TARGET, [0, 1]), (linear(-1.0, 2.0), [0, 1])):
        np.testing.assert_allclose(AGENT.act(None, params, jnp.ones((1, 2)), jax.random.key(0)), [best], atol=1e-6)


def test_the_online_network_chooses_and_the_target_network_values():
    # East by the online values, worth 0.2 to the target network. Its own maximum would give 1 + 0.5 * 5, the online
    # network's value 1 + 0.5 * 1. Nothing follows the termination.
    np.testing.assert_allclose(targets(0.5), [1 + 0.5 * 0.2, 1.0])


def change_by(optimizer, gradient, params) -> Any:
    """The first step of an optimiser."""
    return optimizer.update(gradient, optimizer.init(params), params)[0]


def test_sgd_steps_along_a_gradient_clipped_to_the_global_norm():
    params = {"a": jnp.array([1.0]), "b": jnp.array([1.0])}
    gradient = {"a": jnp.array([3.0]), "b": jnp.array([4.0])}  # of norm 5
    optimizer = ddqn.optimizer("sgd", 0.1, 0.5)
    change = change_by(optimizer, gradient, params)
    assert float(change["a"][0]) == pytest.approx(-0.1 * 0.3)
    assert float(change["b"][0]) == pytest.approx(-0.1 * 0.4)
    short = {"a": jnp.array([0.3]), "b": jnp.array([0.0])}
    assert float(change_by(optimizer, short, params)["a"][0]) == pytest.approx(-0.03)
