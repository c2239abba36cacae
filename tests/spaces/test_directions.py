"""Geometry of directions: by hand, and against float64 NumPy."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.spaces import DIRECTIONS, directions

DEG = math.pi / 180


def direction(degrees):
    return directions.from_angle(jnp.array(degrees * DEG))


def test_rotate_is_counterclockwise():
    np.testing.assert_allclose(directions.rotate(jnp.array([1.0, 0.0]), math.pi / 2), [0, 1], atol=1e-7)
    np.testing.assert_allclose(directions.rotate(jnp.array([3.0, 4.0]), -math.pi / 2), [4, -3], atol=1e-6)


@pytest.mark.parametrize(
    ("start", "end", "turn"), [(0, 30, 30), (30, 0, -30), (170, -170, 20), (-170, 170, -20), (45, 45, 0)]
)
def test_difference_is_signed_and_wraps(start, end, turn):
    assert float(directions.difference(direction(start), direction(end))) / DEG == pytest.approx(turn, abs=1e-4)


@pytest.mark.parametrize("length", [2e-38, 1.0, 3e38])
def test_retract_takes_any_length(length):
    np.testing.assert_allclose(directions.retract(jnp.array([0.0, -length])), [0.0, -1.0], atol=1e-6)


@pytest.mark.parametrize("vector", [[np.nan, 0.0], [0.0, np.nan], [np.inf, 0.0], [np.nan, np.nan]])
def test_what_is_not_finite_is_no_direction(vector):
    assert np.isnan(directions.retract(jnp.array(vector))).all()
    assert np.isnan(DIRECTIONS.only_actions(jnp.array(vector))).all()


def test_no_action_is_zero_and_actions_stay_as_they_are():
    given = np.float32([[0.0, 0.0], [0.6, -0.8], [1e30, 0.0]])
    np.testing.assert_array_equal(DIRECTIONS.only_actions(given), [[np.nan, np.nan], *given[1:]])


@pytest.mark.parametrize(
    ("action", "base", "radius", "clipped"),
    [
        (25, 10, 20, 25),
        (50, 10, 20, 30),
        (-50, 10, 20, -10),
        (-160, 175, 10, -175),  # over the wrap: 25 deg counterclockwise of the base
        (160, -175, 10, 175),
        (80, 30, 0, 30),
    ],
)
def test_clip_to_ball(action, base, radius, clipped):
    result = DIRECTIONS.clip(direction(action), direction(base), radius * DEG)
    assert float(directions.to_angle(result)) / DEG == pytest.approx(clipped, abs=1e-4)


@pytest.mark.parametrize("radius", [math.pi, 100.0])
def test_a_ball_of_half_a_turn_or_more_leaves_every_action_alone(radius):
    base = directions.evenly_spaced(36)
    action = jnp.roll(base, 18, axis=0)  # opposite
    np.testing.assert_array_equal(DIRECTIONS.clip(action, base, radius), action)


def test_uniform_directions_are_units_that_cover_the_circle():
    drawn = np.asarray(directions.uniform(jax.random.key(0), (40, 100)))
    assert drawn.shape == (40, 100, 2)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=-1), 1, atol=1e-6)
    counts, _ = np.histogram(np.arctan2(drawn[..., 1], drawn[..., 0]), bins=8, range=(-math.pi, math.pi))
    assert counts.min() > 400  # 500 each, standard deviation 21
    assert counts.max() < 600


def windows(count, *intervals):
    """1 on the given intervals of indices, 0 elsewhere."""
    values = np.zeros(count, np.float32)
    for first, last in intervals:
        values[first : last + 1] = 1
    return jnp.array(values)


def index_of(best, count):
    return round(float(directions.to_angle(best)) / (2 * math.pi / count)) % count


@pytest.mark.parametrize("shift", [0, 90])
def test_habit_settles_exact_ties_by_the_smaller_turn_from_x(shift):
    values = windows(360, (20 + shift, 30 + shift), (150 + shift, 160 + shift), (240 + shift, 250 + shift))
    assert index_of(directions.best_direction(values, 1 * DEG, 0.1), 360) == pytest.approx(25 + shift, abs=3)


def test_expected_value_is_that_of_a_gaussian_aim():
    count, spread, habit = 60, 0.3, 0.25
    values = np.random.default_rng(2).uniform(0, 1, count)
    turn = 2 * np.pi * np.arange(count) / count
    apart = np.abs(turn[:, None] - turn[None])
    kernel = np.exp(-0.5 * (np.minimum(apart, 2 * np.pi - apart) / spread) ** 2)
    expected = (kernel / kernel.sum(1, keepdims=True)) @ values * (1 - habit * turn / (2 * np.pi))
    assert index_of(directions.best_direction(jnp.array(values), spread, habit), count) == np.argmax(expected)


@pytest.mark.parametrize(
    ("share", "action", "nearest"),
    [
        (0.6, 90, 100),  # a narrower window, worth 0.7 of the best one
        (0.8, 90, 20),  # for which that is too little
        (0.6, 101.3, 101),  # already good
        (0.6, 62, 100),  # 38 degrees away, the other 42
        (0.6, 300, 10),  # over the wrap: 70 degrees, not 158
        (0.0, 222.2, 222),  # anything is good
    ],
)
def test_the_nearest_good_direction_by_hand(share, action, nearest):
    values = windows(360, (10, 20)) + 0.7 * windows(360, (100, 102))
    found = directions.nearest_direction(values, 0.0, share, directions.from_angle(action * DEG))
    assert index_of(found, 360) == nearest


def test_worth_is_averaged_over_the_aim_before_it_is_called_good():
    values = windows(360, (10, 30)) + windows(360, (100, 100))  # one direction alone: nobody hits it
    assert index_of(directions.nearest_direction(values, 0.0, 0.6, directions.from_angle(90 * DEG)), 360) == 100
    assert index_of(directions.nearest_direction(values, 3 * DEG, 0.6, directions.from_angle(90 * DEG)), 360) == 29


def test_where_nothing_is_worth_anything_the_best_alone_is_good():
    values = jnp.zeros(360) - windows(360, (0, 49), (51, 359))
    found = directions.nearest_direction(values, 0.0, 0.6, directions.from_angle(200 * DEG))
    assert index_of(found, 360) == index_of(directions.best_direction(values, 0.0, 0.0), 360) == 50
