"""Statistics against hand-computed values, scipy's own trimmed mean and known coverage."""

import numpy as np
import pytest

from cuelearner_jax.evaluate import group_means
from cuelearner_jax.report import statistics
from cuelearner_jax.report.statistics import Interval


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([5.0], 5.0),
        ([1.0, 2.0, 9.0], 4.0),  # up to 3: the plain mean
        ([0.0, 1.0, 3.0, 100.0], 2.0),  # 4: one dropped at each end
        ([7.0, -50.0, 1.0, 4.0, 1000.0], 4.0),  # 5: the middle three
        ([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 99.0, 99.0], 2.5),  # 8: two dropped at each end
    ],
)
def test_interquartile_mean_by_hand(values, expected):
    assert statistics.interquartile_mean(values) == pytest.approx(expected)


def test_intervals_of_normal_data_cover_the_truth_as_often_as_the_docstring_says():
    rng = np.random.default_rng(0)
    for seeds, expected in ((2, 0.5), (3, 0.75), (5, 0.90), (20, 0.945)):
        found = statistics.interval(rng.normal(size=(seeds, 1500)), resamples=1000)
        assert np.mean((found.lower <= 0) & (found.upper >= 0)) == pytest.approx(expected, abs=0.03)


def test_equal_seeds_have_no_width_and_a_single_seed_no_interval():
    np.testing.assert_array_equal(np.array(statistics.interval(np.full((5, 2), 0.25))), 0.25)
    single = statistics.interval(np.array([[1.0, 2.0]]))
    np.testing.assert_array_equal(single.estimate, [1.0, 2.0])
    assert np.isnan(single[1:]).all()


def test_the_probability_of_improvement_counts_pairs():
    values, others = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]), np.array([[2.0, 0.0], [1e-9, 1.0]])
    np.testing.assert_allclose(statistics.improvement(values, others), [4.5 / 6, 1.5 / 6])


def test_the_mean_over_uneven_steps_by_hand():
    steps, values = np.array([0, 10, 40]), np.array([[0.0, 1.0, 1.0], [2.0, 2.0, 2.0]])
    np.testing.assert_allclose(statistics.mean_over_curve(steps, values), [0.875, 2.0])
    np.testing.assert_allclose(statistics.mean_over_curve(np.array([5]), values[:, :1]), [0.0, 2.0])
    np.testing.assert_allclose(statistics.mean_over_curve(steps, values, (5, 20)), [(0.75 * 5 + 10) / 15, 2.0])


def test_a_level_is_reached_where_the_nondecreasing_fit_reaches_it():
    values = np.array([[0.0, 0.5, 0.4, 0.6], [0.9, 0, 0, 0], [0.1, 0.2, 0.3, 0.4], np.float32([0.9, 0.1, 0.9, 0.1])])
    found = statistics.steps_to_level(np.array([0, 10, 20, 30]), values, 0.5)
    np.testing.assert_allclose(statistics.nondecreasing(values)[:2], [[0.0, 0.45, 0.45, 0.6], [0.225] * 4])
    np.testing.assert_allclose(found, [[20 + 10 / 3] * 2, [30.0, np.inf], [30.0, np.inf], [0.0, 0.0]])
    assert statistics.censored_interval(np.array([[1.0, 1.0], *[[2.0, 2.0]] * 98, [3.0, np.inf]])) == (2.0, 2.0)
    assert statistics.censored_interval(np.array([[3.0, np.inf]] * 9)) == (3.0, np.inf)


def test_intervals_of_the_steps_to_a_level_near_the_plateau_cover_the_truth():
    """Eight seeds of their own pace, on 100 episodes each: success rises to 0.95, the level is 0.93."""
    rng, steps, covered = np.random.default_rng(0), np.arange(31), []
    for middle in 8 + 2 * rng.normal(size=(60, 8, 1)):  # of the rise
        each = rng.binomial(5, 0.95 / (1 + np.exp((middle - steps) / 1.2))[:, None], (8, 20, 31)) / 5
        draws = statistics.resampled(each, 200, of=lambda curves: statistics.steps_to_level(steps, curves, 0.93))
        lower, upper = statistics.censored_interval(draws)
        covered.append(lower <= 8 + 1.2 * np.log(0.93 / 0.02) <= upper)
    assert sum(covered) >= 54  # of 60; of the steps from which curves stay at the level none does


def test_an_interval_covers_the_truth_only_if_it_draws_the_shared_episodes_too():
    """Seeds near 0 that all meet the same 40 episodes: their luck is no difference between seeds."""
    rng, covered = np.random.default_rng(4), []
    for _ in range(200):
        each = 0.1 * rng.normal(size=(10, 1)) + rng.normal(size=40) + rng.normal(size=(10, 40))
        found = [statistics.interval(each.mean(-1), part, 400) for part in (None, group_means(each))]
        covered.append([each.lower < 0 < each.upper for each in found])
    alone, both = np.mean(covered, axis=0)
    assert alone < 0.75
    assert 0.9 < both < 0.99


def test_no_interval_is_printed_with_a_width_of_zero():
    shown = [f"{Interval(*map(np.array, ends))}" for ends in ((0.97, 0.96996, 0.97004), (0.97,) * 3)]
    assert shown == ["0.97000 [0.96996, 0.97004]", "0.970 [no spread]"]


def test_whole_curves_are_drawn_in_streams_of_their_own():
    values = np.random.default_rng(3).normal(size=(9, 1, 1))
    drawn = statistics.resampled(np.repeat(values, 2, axis=2))
    np.testing.assert_array_equal(drawn[:, 0], drawn[:, 1])  # two steps at which each seed has one value
    assert (statistics.resampled(values, seed=1) != drawn[:, :1]).any()
