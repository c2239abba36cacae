"""Choices: steps along a row, or no cue at all; a description in files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import RELATIVE, SCALAR, relative_feedback
from cuelearner_jax.spaces import Choices, Cue, from_json

GEARS = Choices(5, Cue("gear", ("higher", "lower"), ("PageUp", "PageDown"), "steps"))
FRUIT = Choices(3)
KEY = jax.random.key(0)


def number(action):
    return np.argmax(np.asarray(action), -1)


def test_log_counts_the_steps_that_exp_goes_and_the_row_ends():
    every = jnp.eye(5)
    steps = np.asarray(GEARS.log(every[:, None], every[None]))[..., 0]
    np.testing.assert_array_equal(steps, np.arange(5)[None] - np.arange(5)[:, None])
    np.testing.assert_array_equal(
        number(GEARS.exp(every[:, None], jnp.asarray(steps)[..., None])), np.tile(np.arange(5), (5, 1))
    )
    np.testing.assert_array_equal(number(GEARS.exp(every[2], jnp.array([[-9.0], [0.4], [0.6], [9.0]]))), [0, 2, 3, 4])
    assert float(GEARS.distance(every[0], every[4])) == GEARS.reach == 4.0
    np.testing.assert_array_equal(number(GEARS.clip(every, every[0], 1.0)), [0, 1, 1, 1, 1])


def test_a_relative_answer_of_ordered_choices_leads_step_by_step():
    action, best = jnp.eye(5)[1], jnp.eye(5)[4]
    for expected in (2, 3, 4, 4):
        action = GEARS.toward(action, relative_feedback(GEARS, action, best, 1.0), 1.0)
        assert number(action) == expected


def test_choices_without_an_order_have_no_cue_and_differ_or_do_not():
    every = jnp.eye(3)
    assert (FRUIT.cues, RELATIVE.width(FRUIT), SCALAR.width(FRUIT)) == ((), 0, 1)
    np.testing.assert_array_equal(FRUIT.distance(every[:, None], every[None]), 1 - np.eye(3))
    assert FRUIT.log(every[0], every[2]).shape == (0,)
    np.testing.assert_array_equal(FRUIT.exp(every[1], jnp.zeros(0)), every[1])
    np.testing.assert_array_equal(FRUIT.clip(every[2], every[0], 0.5), every[2])  # a bound holds nothing


def test_samples_are_choices_each_as_often_and_the_spread_is_all_of_them():
    drawn = np.asarray(GEARS.sample(KEY, (2000,)))
    np.testing.assert_array_equal(drawn.sum(-1), 1)
    np.testing.assert_allclose(drawn.mean(0), 0.2, atol=0.04)  # standard deviation 0.009
    np.testing.assert_array_equal(GEARS.spread(99), np.eye(5))
    near = jnp.array([[0.1, 0.7, 0.2, 0.0, 0.0], [jnp.nan, 0.0, 0.0, 0.0, 0.0]])
    assert number(GEARS.retract(near))[0] == 1
    assert np.isnan(GEARS.retract(near)[1]).all()


@pytest.mark.parametrize("space", [GEARS, FRUIT], ids=["ordered", "not ordered"])
def test_a_file_describes_choices(space):
    assert from_json(space.to_json()) == space
    assert space.words_of(np.eye(space.count)[1]) == f"choice 2 of {space.count}"


def test_what_makes_no_choices_is_refused():
    with pytest.raises(UserError, match="at least two choices"):
        Choices(1)
    with pytest.raises(UserError, match="an order of the unit 'steps'"):
        Choices(3, Cue("gear", ("higher", "lower"), ("a", "b"), "degrees"))
    with pytest.raises(ValueError, match="unknown code"):
        from_json({**FRUIT.to_json(), "name": "fruit"})
    with pytest.raises(ValueError, match="unknown to this program"):
        from_json({**FRUIT.to_json(), "low": [0.0]})
