"""Between the nodes at which a policy was asked: exact where the policy is smooth, unsure where it jumps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.calibration.families import Distortion, Unknown
from cuelearner_jax.calibration.likelihood import chances
from cuelearner_jax.calibration.meaning import Meaning
from cuelearner_jax.calibration.response import MOST, Responses
from cuelearner_jax.policies import policy_of
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import from_angle

EPS = 0.1
SHIFT = Distortion("shift", (Unknown("x", "m"), Unknown("y", "m")), lambda theta, obs: obs - theta)


def responses(angle, count=None):
    """A policy that points at an angle of two numbers; `count`: collects how many rows it was asked about."""

    def act(obs):
        if count is not None:
            count.append(len(obs))
        return np.asarray(from_angle(angle(obs)), np.float32)

    return Responses(Meaning(policy_of(act), DIRECTIONS), (SHIFT,), {"x": 0.5, "y": 0.5}, EPS)


def test_a_linear_policy_is_known_between_nodes():
    known = responses(lambda obs: 0.3 * obs[:, 0] - 0.2 * obs[:, 1])
    obs = np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    theta = np.array([[0.2, 0.7], [-0.9, 0.4]])
    mean, spread = known.respond(obs).at(theta)
    true = -(0.3 * theta[:, 0] - 0.2 * theta[:, 1]) * 0.5 / EPS  # [eps], of every row alike
    np.testing.assert_allclose(mean[..., 0], np.tile(true[:, None], (1, 5)), atol=0.05)
    assert spread.max() < 0.1


def test_where_the_policy_jumps_the_spread_tells():
    known = responses(lambda obs: np.where(obs[:, 0] > 0.2, 0.0, 1.0))
    obs = np.array([[0.3, 0.0], [3.0, 0.0]], np.float32)  # one near the jump, one far from it
    _, spread = known.respond(obs).at(np.array([[0.4, 0.0]]))
    assert spread[0, 0, 0] > 1
    assert spread[0, 1, 0] < 0.1


def test_no_row_is_asked_twice_and_nodes_follow_what_is_likely():
    count = []
    known = responses(lambda obs: obs[:, 0], count)
    random, obs = np.random.default_rng(0), np.zeros((4, 2), np.float32)
    known.respond(obs)
    asked = len(count)
    known.respond(obs)
    assert len(count) == asked
    draws = np.array([0.6, -0.3]) + 0.05 * random.standard_normal((50, 2))
    for _ in range(MOST):
        known.add_nodes(draws, 3, random)
    assert len(known.nodes) == MOST
    np.testing.assert_array_equal(known.nodes[0], 0)  # no change stays
    assert (np.abs(known.nodes[1:] - [0.6, -0.3]).max(1) < 0.5).mean() > 0.8


@pytest.mark.parametrize("answer", [-1, 0, 1])
def test_spread_is_a_mean_over_what_may_be_meant(answer):
    offset, spread = 1.5, 2.0
    draws = offset + spread * np.random.default_rng(0).standard_normal(20_000)
    sampled = jax.jit(jax.vmap(lambda one: chances(one, 0.0 * one, answer)))(np.float32(draws)).mean(0)
    found = chances(jnp.array([offset]), jnp.array([spread]), answer)[0]
    np.testing.assert_allclose(found, sampled, atol=0.05)  # of the normal spread, a logistic one is made
