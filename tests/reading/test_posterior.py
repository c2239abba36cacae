"""The posterior of one weight, against its integral, and where there is none."""

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.reading import fitting, posterior
from cuelearner_jax.reading.likelihood import intervals, log_likelihood
from cuelearner_jax.reading.linear import SCALE, Change, ObservationFrame
from cuelearner_jax.reading.posterior import SIZE, TAU, Data, Hyper, ModelParts

EPS, COUNT, TRUTH = 1 / SCALE, 24, 0.6
PARTS = ModelParts(jnp.ones(1), False)


def answered():
    """A teacher without fault speaks of actions beside the right one."""
    offset = np.random.default_rng(0).uniform(-1.6, 0.4, (COUNT, 1)).astype(np.float32)
    answer = np.where(np.abs(offset + TRUTH) <= EPS / 2, 0.0, np.sign(offset + TRUTH)).astype(np.float32)
    room = jnp.full((COUNT, 1), jnp.inf)
    said = intervals(jnp.asarray(answer), jnp.ones(COUNT, bool), room, room, TAU * EPS)
    return Data(jnp.asarray(offset), jnp.ones((COUNT, 1, 1)), jnp.zeros((COUNT, 1)), said, (0,))


def test_one_weight_has_the_posterior_of_its_integral_and_a_bound_below_its_evidence():
    data, zero = answered(), jnp.zeros(())
    hyper = Hyper(jnp.zeros(1), jnp.zeros(1), jnp.zeros(1), zero, zero, jnp.zeros(1), zero, zero, zero, 0)
    found = posterior.infer(data, PARTS, jnp.float32(EPS), posterior.unread(data, hyper))
    habits = posterior.habits(found.hyper, EPS)
    size = float(SIZE * np.exp(found.hyper.groups[0] + found.hyper.sizes[0]))
    grid = np.linspace(-1.0, 2.0, 1501)
    said = [log_likelihood(data.offset + u, data.answers, habits).sum() for u in grid[::10]]
    height = np.exp(np.interp(grid, grid[::10], said) - 0.5 * (grid / size) ** 2) / (size * np.sqrt(2 * np.pi))
    volume = np.trapezoid(height, grid)
    mean = np.trapezoid(grid * height, grid) / volume
    spread = np.sqrt(np.trapezoid((grid - mean) ** 2 * height, grid) / volume)
    assert abs(found.mean[0] - mean) < 0.2 * spread
    np.testing.assert_allclose(abs(found.root[0, 0]), spread, rtol=0.2)
    evidence = np.log(volume) + float(posterior._log_prior(found.hyper, PARTS))
    assert evidence - 0.3 < found.bound < evidence + 0.01


def test_a_hypothesis_without_a_finite_posterior_stays_as_it_was():
    data, zero, one = answered(), jnp.zeros(()), jnp.ones(1)
    frame = ObservationFrame(jnp.zeros(1), one, one, one, jnp.zeros(0, int))
    hyper = Hyper(jnp.zeros(1), jnp.zeros(1), jnp.zeros(1), zero + 60, zero, jnp.zeros(1), zero, zero, zero, 0)
    change = Change(0.3 * one, jnp.zeros((0, 0)), jnp.zeros(1), jnp.zeros((1, 0)))
    alone = data, fitting.Hypothesis(ModelParts(one, True), change, hyper), posterior.unread(data, hyper)
    rows, hypothesis, before = jax.tree.map(lambda leaf: leaf[None], alone)
    jax.tree.map(np.testing.assert_array_equal, fitting._update(rows, frame, hypothesis, before), (before, hypothesis))
