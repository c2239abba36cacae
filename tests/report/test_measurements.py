"""Intervals of measured policies and of differences between two, over what they are said to be."""

import numpy as np
import pytest
import scipy.stats

from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import group_means, mean_interval
from cuelearner_jax.report import measurements
from cuelearner_jax.report.statistics import interval
from cuelearner_jax.studies.evaluate import Measured

RANDOM = np.random.default_rng(5)
EPISODES = 200
HARD = RANDOM.normal(size=EPISODES)  # what all policies find hard or easy, episode by episode


def measured(seeds, gain=0.0, labels=0, **other):
    """Rows of policies that share their episodes' luck and differ by `gain` and a little."""
    each = HARD + gain + 0.1 * np.random.default_rng(seeds).normal(size=(len(seeds), EPISODES))
    return Measured("relative", labels, 100, np.array(seeds), {"reward": each.mean(-1)}, {"reward": each}, **other)


def test_an_interval_of_a_mean_covers_it_in_95_of_100_also_of_few_values():
    for count in (3, 50):
        samples = np.random.default_rng(2).normal(size=(4_000, count))
        mean, lower, upper = mean_interval(samples)
        np.testing.assert_allclose(mean, samples.mean(-1))
        assert np.mean((lower <= 0) & (upper >= 0)) == pytest.approx(0.95, abs=0.01)
    assert np.isnan(mean_interval(np.array([0.5]))[1:]).all()
    for successes in (0, 3, 20):
        ends = scipy.stats.binomtest(successes, 20).proportion_ci(method="wilson")
        share = mean_interval(np.repeat([1.0, 0.0], [successes, 20 - successes]), is_share=True)
        assert share == pytest.approx((successes / 20, *ends))


def test_one_policy_has_an_interval_over_episodes_and_several_over_seeds():
    one, many = measured([1]), measured([1, 2, 3, 4, 5])
    assert (measurements.over(one), measurements.over(many)) == ("episodes", "seeds")
    found = measurements.spread(one, "reward")
    assert found is not None
    assert found.upper - found.lower == pytest.approx(4 * HARD.std() / np.sqrt(EPISODES), rel=0.15)
    over_both = measurements.spread(many, "reward")
    assert over_both is not None
    assert over_both == interval(many.metrics["reward"], group_means(many.each["reward"]))
    assert over_both.upper - over_both.lower > 0.2  # the seeds differ by 0.02, their episodes' luck is the same
    alike = Measured("-", 0, 0, np.arange(3), {"reward": np.ones(3)}, {"reward": np.ones((3, 9))}, is_shared=True)
    assert measurements.over(alike) == "episodes"  # three seeds of one policy are no spread over seeds
    assert measurements.spread(one._replace(metrics={"success": np.array([np.nan])}), "success") is None


def test_a_share_of_all_episodes_has_an_interval():
    row = measured([1, 2])._replace(metrics={"success": np.ones(2)}, each={"success": np.ones((2, 50))})
    # of the 50 of 50 that both share
    assert measurements.spread(row, "success") == pytest.approx((1, 0.929, 1), abs=1e-3)
    lost = row._replace(metrics={"success": np.zeros(2)}, each={"success": np.zeros((2, 50))})
    assert measurements.spread(lost, "success") == pytest.approx((0, 0, 0.071), abs=1e-3)
    assert measurements.spread(row._replace(is_shared=True), "success") == pytest.approx((1, 0.929, 1), abs=1e-3)
    sums = measured([1])._replace(metrics={"return": np.zeros(1)}, each={"return": np.zeros((1, 50))})  # no share
    assert measurements.spread(sums, "return") == (0, 0, 0)


def test_a_difference_of_two_policies_is_paired_by_episode():
    (found,) = measurements.differences([measured([1], 0.1)], [measured([2])])
    assert found.over == "episodes"
    less = found.metrics["reward"]
    assert less.excludes_zero
    assert less.upper - less.lower < 0.05  # unpaired it would be 0.4
    (same,) = measurements.differences([measured([1])], [measured([1])])
    assert same.metrics["reward"] == (0.0, 0.0, 0.0)
    assert not same.metrics["reward"].excludes_zero


def test_differences_of_seeds_are_paired_where_seeds_are_the_same():
    several = measured([1, 2, 3, 4], 0.1)
    widths = []
    for others in (measured([1, 2, 3, 4]), measured([7, 8, 9, 10]), measured([7])):
        (found,) = measurements.differences([several], [others])
        less = found.metrics["reward"]
        assert found.over == "seeds"
        assert less.lower <= less.estimate <= less.upper
        assert less.estimate == pytest.approx(0.1, abs=0.02)
        widths.append(less.upper - less.lower)
    assert widths[0] == pytest.approx(0, abs=1e-6)  # the same luck, seed by seed
    assert min(widths[1:]) > 0.01


def test_variants_are_compared_with_their_own_kind_or_refused():
    rows = [measured([1], labels=100), measured([1], labels=500)]
    assert [one.other.labels for one in measurements.differences(rows, rows[::-1])] == [100, 500]
    with pytest.raises(UserError, match=r"has 2 variants .* but not relative, 250 labels"):
        measurements.differences([measured([1], labels=250)], rows)
