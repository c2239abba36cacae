"""Relative feedback against brute force; the teacher's faults; the laws of fitting."""

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.agents.networks import MLP, as_function
from cuelearner_jax.config import Scalars, Sizes
from cuelearner_jax.feedback.answers import relative_feedback
from cuelearner_jax.guides.fitting import Example, fit_model, squared_errors
from cuelearner_jax.spaces import DIRECTIONS, directions

DEG = math.pi / 180


def direction(degrees):
    return directions.from_angle(jnp.array(degrees * DEG))


def test_an_error_of_exactly_half_eps_is_right():
    action, best = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
    error = directions.difference(action, best)
    assert float(relative_feedback(DIRECTIONS, action, best, 2 * error)[0]) == 0
    assert float(relative_feedback(DIRECTIONS, action, best, 2 * jnp.nextafter(error, 0.0))[0]) == 1


def test_indifference_widens_what_is_right_and_never_narrows_it():
    told = partial(relative_feedback, DIRECTIONS, direction(0), eps=jnp.array(10 * DEG))
    assert float(told(direction(7))[0]) == 1
    assert float(told(direction(7), indifference=8 * DEG)[0]) == 0
    assert float(told(direction(9), indifference=8 * DEG)[0]) == 1
    assert float(told(direction(4), indifference=1 * DEG)[0]) == 0


@pytest.mark.parametrize("eps_deg", [0.1, 20.0, 179.0])
def test_feedback_is_the_turn_that_comes_nearest(eps_deg):
    action, best = np.random.default_rng(int(eps_deg * 10)).uniform(-math.pi, math.pi, (2, 2000))
    both = (directions.from_angle(jnp.array(angles)) for angles in (action, best))
    h = jax.vmap(partial(relative_feedback, DIRECTIONS), (0, 0, None))(*both, jnp.array(eps_deg * DEG))
    turns = np.array([-1, 0, 1])
    left = np.abs(np.angle(np.exp(1j * (best[:, None] - action[:, None] - turns * eps_deg * DEG))))
    two_best = np.sort(left, axis=1)[:, :2]
    clear = two_best[:, 1] - two_best[:, 0] > 1e-5
    assert clear.mean() > 0.98
    np.testing.assert_array_equal(np.asarray(h)[clear, 0], turns[np.argmin(left, 1)][clear])


SIZES = Sizes(feedback_layers=(32, 32), fit_steps=600, fit_batch_size=32, validate_every=20)
SCALARS = Scalars(feedback_learning_rate=5e-3)
ROWS = 100
NETWORK = MLP(SIZES.feedback_layers, 2)
HELD_OUT = np.arange(ROWS) % 5 == 4
predict = as_function(NETWORK)


@jax.jit
def fit(key, rows):
    init = lambda key: NETWORK.init(key, jnp.zeros(2), jnp.zeros(2))  # noqa: E731
    losses = lambda params, rows: squared_errors(rows, predict(params, rows.obs, rows.action))  # noqa: E731
    return fit_model(key, rows, SCALARS, init=init, losses=losses, sizes=SIZES)


def label_set(seed, noise=0.0, valid=ROWS, dtype=np.float32):
    """A smooth function of observation and action, in the first `valid` rows."""
    rng = np.random.default_rng(seed)
    obs, action = rng.uniform(-1, 1, (2, ROWS, 2)).astype(dtype)
    action /= np.linalg.norm(action, axis=-1, keepdims=True)
    target = 0.3 * action[:, ::-1] * obs + noise * rng.normal(size=(ROWS, 2))
    return Example(obs, action, target.astype(dtype), np.arange(ROWS) < valid)


def mean_error(model, labels, rows):
    error = np.asarray(predict(model.params, jnp.asarray(labels.obs), jnp.asarray(labels.action))) - labels.target
    return float(np.square(error).sum(-1)[rows].mean())


def assert_same(one, other):
    for mine, yours in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(mine, yours)


@pytest.mark.parametrize("garbage_values", [(1e3, -7.0, 55.0), (math.nan, math.inf, math.nan)])
def test_what_stands_in_rows_that_are_not_valid_changes_nothing(garbage_values):
    labels = label_set(1, valid=53)
    garbage = jax.tree.map(np.copy, labels)
    for name, value in zip(("obs", "action", "target"), garbage_values, strict=True):
        getattr(garbage, name)[53:] = value
    assert_same(fit(jax.random.key(0), labels), fit(jax.random.key(0), garbage))


def test_of_all_looks_the_one_nearest_to_the_validation_labels_is_kept():
    # A model of one vector, which walks from 0 by 0.01 a step toward (1, 0): 0.2, 0.4, 0.6, 0.8 at the looks.
    labels = label_set(0).replace(target=np.stack([np.where(HELD_OUT, 0.45, 1.0), np.zeros(ROWS)], -1))
    model = fit_model(
        jax.random.key(0),
        jax.tree.map(jnp.asarray, labels),
        Scalars(feedback_learning_rate=0.01, max_grad_norm=0.1),
        init=lambda key: jnp.zeros(2),
        losses=lambda params, rows: squared_errors(rows, jnp.broadcast_to(params, rows.action.shape)),
        sizes=dataclasses.replace(SIZES, fit_steps=80),
    )
    np.testing.assert_allclose(model.params, [0.4, 0.0], atol=1e-3)


def test_validation_labels_are_never_trained_on():
    labels = label_set(3)
    opposite = labels.replace(target=np.where(HELD_OUT[:, None], -labels.target, labels.target))
    zero = float(np.square(labels.target).sum(-1)[HELD_OUT].mean())
    assert mean_error(fit(jax.random.key(0), labels), labels, HELD_OUT) < 0.3 * zero
    assert mean_error(fit(jax.random.key(0), opposite), opposite, HELD_OUT) > 0.7 * zero


def test_without_a_valid_label_nothing_is_fitted():
    assert not bool(fit(jax.random.key(0), label_set(0, valid=0)).fitted)
    assert bool(fit(jax.random.key(0), label_set(0, valid=1)).fitted)
