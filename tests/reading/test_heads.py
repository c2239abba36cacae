"""A robot that heads for its goal in the plane: near the goal its direction turns by any angle, so slopes mislead."""

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.reading import Reading
from cuelearner_jax.spaces import DIRECTIONS

LABELS, BATCHES, EPS_DEG = 96, 3, 9.0  # by 48 rounding decides which optimum is found
ASIDE = np.array([1.2, -0.9, 0, 0, 0, 0], np.float32)  # farther than goals are away


@jax.jit
def policy(obs):
    """Head for the goal, the first two entries, from the place, the next two."""
    return DIRECTIONS.retract(obs[:, :2] - obs[:, 2:4])


def met(random):
    """Situations; the last two entries are of no use."""
    obs = random.uniform(-1, 1, (40, 6)).astype(np.float32)
    obs[:, :2] = obs[:, 2:4] + random.uniform(-0.8, 0.8, (40, 2))
    return obs


def read(right, aside):
    """Return the reading of labels, and its mean error in other situations [deg]."""
    reading, random = Reading(policy, (), DIRECTIONS, EPS_DEG, LABELS), np.random.default_rng(1)
    for batch in range(BATCHES):
        obs = met(random) + aside
        index, action = reading.questions(obs, LABELS // BATCHES, jax.random.key(batch))
        turn = np.asarray(DIRECTIONS.log(action, right(obs[index])))
        reading.learn(obs[index], action, np.where(np.abs(turn) <= reading.eps / 2, 0, np.sign(turn)))
    obs = jnp.asarray(met(random) + aside)
    return reading.result(), float(jnp.rad2deg(DIRECTIONS.distance(reading.act(obs), right(obs)).mean()))


def test_a_goal_that_is_seen_farther_aside_than_it_is_away_is_found():
    result, error = read(lambda obs: policy(np.asarray(obs) - ASIDE), ASIDE)
    assert result.used
    assert error < 2.0
    assert result.near == 1.0


def test_a_slow_axis_turns_directions_by_twice_their_angle():
    result, error = read(lambda obs: DIRECTIONS.retract(policy(obs) * jnp.array([[2.0, 1.0]])), np.zeros(6, np.float32))
    assert result.used
    assert error < 3.0
