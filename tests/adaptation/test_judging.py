"""The sequential test of a correction against the policy as it was."""

from types import SimpleNamespace

import numpy as np

from cuelearner_jax.adaptation.judging import Judge, Judging, PairedTest, differences


def judged(before, after, lanes=1, seed=0, episodes=50, at_once=10):
    """Play episodes of policies with these chances of success."""
    random, test = np.random.default_rng(seed), PairedTest(lanes)
    for _ in range(episodes // at_once):
        one, other = (random.random((lanes, at_once)) < chance for chance in (before, after))
        test.add(differences(({"success": one * 1.0}, {"success": other * 1.0}), "success"))
    return test


def test_a_better_policy_is_accepted_and_a_worse_one_rejected():
    assert judged(0.59, 1.0, lanes=20).better.all()
    harm = judged(0.59, 0.045, lanes=20)
    assert harm.worse.all()
    assert not harm.better.any()


def test_a_tie_is_never_used():
    for chance in (0.0, 1.0):
        assert not judged(chance, chance, lanes=20).decided.any()


def test_of_policies_that_are_as_good_one_in_twenty_at_most_is_accepted():
    assert judged(0.6, 0.6, lanes=2000).better.mean() <= 0.05
    random, test = np.random.default_rng(0), PairedTest(2000)
    for _ in range(50):  # returns that are seldom large
        one, other = ({"return": random.lognormal(size=(2000, 10))} for _ in range(2))
        test.add(differences((one, other), "return"))
    assert test.better.mean() <= 0.05


class Recorded(Judge):
    """Has pairs of episodes in place of an adaptation."""

    def _by_metric(self, block):
        return ((pair, np.zeros(1, int)) for pair in self.of)


def is_used(before, after):
    """Whether a correction with these rewards of episodes is used."""
    pairs = [tuple({"reward": one[None, k : k + 10]} for one in (before, after)) for k in range(0, 50, 10)]
    judge = Recorded(pairs, SimpleNamespace(number=1), Judging(None), None, None)
    return judge._by_episodes(SimpleNamespace(failed=np.zeros(1, bool), corrects=np.ones(1, bool)))[2].item()


def test_rare_failures_outweigh_a_gain_elsewhere():
    before, after = np.full(50, 50.0), np.full(50, 80.0)
    assert is_used(before, after)
    for failure, every in ((np.nan, 3), (np.nan, 25), (-2000.0, 25)):  # the mean of all is below 50, or none
        assert not is_used(before, np.where(np.arange(50) % every, after, failure))
    pair = tuple({"reward": np.array([one])} for one in ([50, np.nan, np.nan], [np.nan, np.nan, 80]))
    np.testing.assert_array_equal(differences(pair, "reward"), [[-1, 0, 0]])
