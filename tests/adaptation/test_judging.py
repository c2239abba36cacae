"""The sequential test of a correction against the policy as it was."""

import numpy as np

from cuelearner_jax.adaptation.judging import PairedTest, differences


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
        test = judged(chance, chance, lanes=20)
        assert not test.decided.any()


def test_of_policies_that_are_as_good_one_in_twenty_at_most_is_accepted():
    assert judged(0.6, 0.6, lanes=2000).better.mean() <= 0.05
    random, test = np.random.default_rng(0), PairedTest(2000)
    for _ in range(50):  # returns that are seldom large
        one, other = ({"return": random.lognormal(size=(2000, 10))} for _ in range(2))
        test.add(differences((one, other), "return"))
    assert test.better.mean() <= 0.05
