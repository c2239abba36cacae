"""The sampler where the posterior is known: a bell in eight unknowns, far narrower than the prior."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from cuelearner_jax.calibration.families import Distortion, Unknown
from cuelearner_jax.calibration.posterior import FIRST, PRIOR_FREEDOM, SAMPLES, Fit, Kernels, Round

SIZE, ENOUGH = 8, 250.0
MEAN, SPREAD = np.linspace(-0.3, 0.3, SIZE), np.linspace(0.02, 0.06, SIZE)
NAMES = [f"unknown {number}" for number in range(SIZE)]
FAMILY = (Distortion("all", tuple(Unknown(name, "m") for name in NAMES), acts=lambda theta, action: action),)


class Bell(Fit):
    """Its answers have the likelihood of a bell at `MEAN`, with deviations `SPREAD`."""

    def _round(self, number, proposal, theta):
        likelihood = -0.5 * np.square((theta - MEAN) / SPREAD).sum(-1, keepdims=True)
        return Round(number, proposal, theta, np.zeros((len(theta), 1, 1)), likelihood)


def opened(seed):
    policy: Any = SimpleNamespace(names=[])  # none is asked
    return Bell(FAMILY, dict.fromkeys(NAMES, 1.0), policy, seed)


def is_known(fit):
    mean, low, high = fit.interval()
    assert fit.effective >= ENOUGH
    assert (np.abs(mean - MEAN) < 0.5 * SPREAD).all()
    np.testing.assert_allclose((high - low) / (2 * 1.96 * SPREAD), 1, atol=0.3)  # of 250 samples
    # its integral over the prior, one dimension at a time
    away = np.linspace(-8, 8, 4001)[:, None]
    heights = stats.t.pdf(MEAN + away * SPREAD, PRIOR_FREEDOM) * np.exp(-0.5 * np.square(away))
    volumes = np.trapezoid(heights, away, axis=0) * SPREAD
    assert abs(fit.evidence - np.log(volumes).sum()) < 0.5


@pytest.mark.parametrize("seed", range(3))
def test_from_the_prior_samples_come_to_the_posterior(seed):
    fit = opened(seed)
    for _ in range(4):
        fit._add()
    fit.refine(ENOUGH, 16)
    is_known(fit)


@pytest.mark.parametrize("seed", range(3))
def test_kernels_much_narrower_than_the_posterior_widen_again(seed):
    fit = opened(seed)
    for _ in range(FIRST):
        fit._add()
    narrow = Kernels(MEAN + np.eye(SIZE) * SPREAD, np.diag(0.1 * SPREAD), fit.prior)
    for number in range(FIRST + 1, FIRST + 5):
        fit.rounds.append(fit._round(number, narrow, narrow.draw(fit.random, SAMPLES * SIZE)))
    fit.count = FIRST + 4
    fit._weigh()
    assert fit.effective < ENOUGH
    fit.refine(ENOUGH, 16)
    is_known(fit)
