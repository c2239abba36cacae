"""Answers as intervals: their probabilities, and expectations, against SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate
from scipy.stats import norm

from cuelearner_jax.reading.likelihood import Habits, expected_log_likelihood, intervals, log_likelihood

TAU, WIDTH, LAPSE = 0.5, 0.4, 0.1
HABITS = Habits(jnp.float32(TAU), jnp.float32(WIDTH), jnp.float32(LAPSE))
SAID = jnp.array([[-1.0], [0.0], [1.0]])
MEAN, VARIANCE = jnp.array([[0.3], [0.6], [-0.2]]), jnp.array([[0.1], [0.3], [0.5]])


def named(below=np.inf, above=np.inf):
    """The intervals of the three answers about an action that can be changed so far."""
    return intervals(SAID, jnp.ones(3, bool), jnp.full((3, 1), below), jnp.full((3, 1), above), TAU)


def probability(change, **room):
    return np.exp(log_likelihood(jnp.full((3, 1), change), named(**room), HABITS))[:, 0]


@pytest.mark.parametrize("change", [-3.0, -0.2, 0.0, 1.0])
def test_probabilities_of_the_three_answers_are_one_together(change):
    between = norm.cdf((TAU - change) / WIDTH) - norm.cdf((-TAU - change) / WIDTH)
    assert probability(change).sum() == pytest.approx(1, abs=1e-6)
    assert probability(change)[1] == pytest.approx((1 - LAPSE) * between + LAPSE / 3, abs=1e-6)


def test_at_the_end_of_a_range_right_says_beyond_the_end_too_and_more_says_nothing_else():
    less, right, more = probability(5.0, above=0.1)
    assert right == more == pytest.approx(1 - LAPSE + LAPSE / 3)
    assert less + right <= 1
    less, right, more = probability(-5.0, below=0.1)
    assert less == right == pytest.approx(1 - LAPSE + LAPSE / 3)
    assert right + more <= 1


def test_the_expected_log_likelihood_is_the_integral():
    for row, (mean, variance) in enumerate(zip(MEAN[:, 0], VARIANCE[:, 0], strict=True)):
        spread = float(variance) ** 0.5
        value = lambda t, row=row: np.log(probability(t)[row])  # noqa: E731
        density = lambda t, m=float(mean), s=spread: norm.pdf(t, m, s)  # noqa: E731
        grid = np.linspace(float(mean) - 6 * spread, float(mean) + 6 * spread, 41)
        wanted = integrate.simpson([value(t) * density(t) for t in grid], x=grid)
        assert expected_log_likelihood(MEAN, VARIANCE, named(), HABITS)[row, 0] == pytest.approx(wanted, abs=0.02)
