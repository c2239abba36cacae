"""Double DQN: targets, loss, clipping and averaging with numbers worked out by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.agents import ddqn
from cuelearner_jax.spaces.directions import evenly_spaced
from cuelearner_jax.types import Transition

DIRECTIONS = evenly_spaced(4)  # east, north, west, south


def linear(params, obs, actions):
    """A value that is linear in the action: w . a, times the observation's first entry."""
    value = (actions @ params)[..., None]
    return value * jnp.broadcast_to(obs[..., :1], value.shape)


ONLINE, TARGET = jnp.array([1.0, 0.5]), jnp.array([0.2, 5.0])  # online prefers east, target north


def transition(reward=1.0, discount=1.0):
    return Transition(jnp.array([9.0]), jnp.array([0.0, 1.0]), jnp.array(reward), jnp.array(discount), jnp.array([2.0]))


def test_greedy_is_the_argmax_over_the_directions():
    np.testing.assert_allclose(ddqn.greedy(linear, ONLINE, jnp.array([1.0]), DIRECTIONS), [1, 0], atol=1e-6)
    np.testing.assert_allclose(ddqn.greedy(linear, ONLINE, jnp.array([-1.0]), DIRECTIONS), [-1, 0], atol=1e-6)
    np.testing.assert_allclose(ddqn.greedy(linear, TARGET, jnp.array([1.0]), DIRECTIONS), [0, 1], atol=1e-6)


def test_the_online_network_chooses_and_the_target_network_values():
    target = ddqn.target(linear, ONLINE, TARGET, transition(), DIRECTIONS, 0.5)
    # East by the online values, worth 0.2 * 2 to the target network. Its own maximum would give 1 + 0.5 * 10,
    # the online network's value 1 + 0.5 * 2.
    assert float(target) == pytest.approx(1 + 0.5 * 0.4)


def test_nothing_follows_a_termination():
    assert float(ddqn.target(linear, ONLINE, TARGET, transition(discount=0.0), DIRECTIONS, 0.5)) == 1.0


def test_without_a_target_network_the_target_is_the_reward():
    stored = transition(reward=0.7).replace(next_obs=jnp.zeros(0))
    assert float(ddqn.target(linear, ONLINE, None, stored, DIRECTIONS, 0.0)) == pytest.approx(0.7)


def test_loss_is_the_mean_squared_error_of_the_actions_taken():
    batch = Transition(
        obs=jnp.array([[1.0], [2.0]]),
        action=jnp.array([[1.0, 0.0], [0.0, 1.0]]),
        reward=jnp.zeros(2),
        discount=jnp.zeros(2),
        next_obs=jnp.zeros((2, 0)),
    )
    # Values 1.0 and 2 * 0.5 = 1.0 against 0.4 and 3.0.
    assert float(ddqn.loss(linear, ONLINE, batch, jnp.array([0.4, 3.0]))) == pytest.approx((0.36 + 4.0) / 2)


def test_polyak_moves_the_target_by_the_rate():
    moved = ddqn.polyak({"w": jnp.array([1.0, 2.0])}, {"w": jnp.array([0.0, 4.0])}, 0.25)
    np.testing.assert_allclose(moved["w"], [0.25, 3.5])


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


def test_adam_starts_with_a_step_of_the_learning_rate_against_the_sign():
    params = jnp.array([1.0, 1.0])
    optimizer = ddqn.optimizer("adam", 0.01, 100.0)
    change = change_by(optimizer, jnp.array([2.0, -0.3]), params)
    np.testing.assert_allclose(change, [-0.01, 0.01], rtol=1e-4)


@pytest.mark.parametrize("name", ["sgd", "adam"])
def test_learning_rate_and_norm_may_be_traced(name):
    def change(rate, norm):
        return change_by(ddqn.optimizer(name, rate, norm), jnp.array([3.0, 4.0]), jnp.array([1.0, 1.0]))

    traced = jax.jit(change)
    np.testing.assert_allclose(traced(0.1, 0.5), change(0.1, 0.5), rtol=1e-5)
    np.testing.assert_allclose(traced(0.2, 0.5), 2 * traced(0.1, 0.5), rtol=1e-5)


def test_an_unknown_optimizer_is_named():
    with pytest.raises(ValueError, match="rmsprop"):
        ddqn.optimizer("rmsprop", 0.1, 1.0)
