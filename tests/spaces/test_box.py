"""Boxes of three and seven entries: laws by hand, answers about each entry, refinement, label files, a guide fitted."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from box_task import EPS, SCALARS, SMALL

from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import human_answer
from cuelearner_jax.spaces import UNSAID, Box, Cue, cues_from, from_json
from cuelearner_jax.testing import check_space

LARGE = Box((-1.0,) * 7, tuple(1.0 + 0.5 * entry for entry in range(7)))
KEY = jax.random.key(3)


def test_a_box_keeps_the_laws_and_ends_at_its_bounds():
    check_space(LARGE)
    low, high = np.array(SMALL.low, np.float32), np.array(SMALL.high, np.float32)
    np.testing.assert_allclose(SMALL.log(low, high), np.ones(3), rtol=1e-6)  # shares of the range
    np.testing.assert_allclose(SMALL.exp(low, 3.0 * jnp.ones(3)), high)  # no farther than the bound
    np.testing.assert_array_equal(SMALL.retract(jnp.stack([low - 5, high + 5])), [low, high])


def test_clip_and_approach_go_no_farther_than_the_bound_along_any_entry():
    box = SMALL
    action, base = (box.sample(jax.random.key(seed), (64,)) for seed in (0, 1))
    assert np.abs(box.log(base, box.clip(action, base, 0.25))).max() <= 0.25 + 1e-6
    for bound in (0.0, 0.25, 1.0):
        expected = np.clip(box.log(action, base), -bound, bound)
        np.testing.assert_allclose(box.log(action, box.approach(action, base, bound)), expected, atol=1e-5)
    inside = np.asarray(box.distance(base, action)) <= 0.5
    assert 0 < inside.sum() < 64
    np.testing.assert_array_equal(np.asarray(box.clip(action, base, 0.5))[inside], np.asarray(action)[inside])
    np.testing.assert_array_equal(box.clip(action, base, 1.0), action)


def test_samples_and_the_even_spread_fill_the_box():
    box = LARGE
    low, high = np.array(box.low), np.array(box.high)
    for actions in (np.asarray(box.sample(KEY, (500,))), np.asarray(box.spread(500))):
        shares = (actions - low) / (high - low)
        assert shares.min() >= -1e-6
        assert shares.max() <= 1 + 1e-6
        np.testing.assert_allclose(shares.mean(0), 0.5, atol=0.06)  # of samples: standard deviation 0.013
        np.testing.assert_allclose(shares.std(0), 1 / np.sqrt(12), atol=0.03)
    np.testing.assert_allclose(box.spread(1)[0], (low + high) / 2, rtol=1e-6)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (((0.0, 1.0), (1.0,)), "as many of both"),
        (((0.0, 1.0), (1.0, 1.0)), "each high above its low"),
        (((0.0,), (1.0,), (Cue("a", ("more", "less"), ("q", "a"), "degrees"),)), "of the unit 'shares'"),
    ],
)
def test_bounds_and_cues_that_fit_no_box_are_refused(given, said):
    with pytest.raises(UserError, match=said):
        Box(*given)


def test_mistakes_and_silence_come_upon_each_entry_by_itself():
    action = LARGE.spread(1)[0]
    best = LARGE.exp(action, jnp.full(7, 0.3))

    def answers(**faults):
        scalars = dataclasses.replace(SCALARS, **faults)
        keys = jax.random.split(KEY, 400)
        return map(np.asarray, jax.vmap(lambda key: human_answer(key, LARGE, action, best, scalars))(keys))

    h, answered = answers(mistake_probability=0.25)
    np.testing.assert_allclose((h == -1).mean(0), 0.25, atol=0.09)  # standard deviation 0.022
    assert answered.all()
    h, answered = answers(silence_probability=0.5)
    np.testing.assert_allclose((h == UNSAID).mean(0), 0.5, atol=0.1)
    np.testing.assert_array_equal(answered, (h != UNSAID).any(1))
    np.testing.assert_array_equal(LARGE.toward(action, jnp.full(7, UNSAID), EPS), action)


def test_equal_words_of_two_entries_are_refused():
    with pytest.raises(UserError, match="the same words twice: give each entry its own"):
        cues_from("left,right;left,right")
    assert len(cues_from("left,right;,;,")) == 3  # nothing is asked about the others


@pytest.mark.parametrize("size", [28])
def test_boxes_of_bimanual_arms_and_hands_need_no_cues_and_no_keys(size):
    plain = Box((-1.0,) * size, (1.0,) * size)
    assert [cue.name for cue in plain.cues][::8] == [f"entry {number}" for number in range(1, size + 1, 8)]
    named = Box(plain.low, plain.high, cues_from(";".join(f"more{entry},less{entry}" for entry in range(size))))
    for box in (plain, named):
        keys = [key for cue in box.cues for key in cue.keys]
        assert len(keys) == len(set(keys)) > 16
        assert from_json(box.to_json()) == box
        np.testing.assert_allclose(box.exp(*map(jnp.asarray, (box.low, np.ones(size)))), box.high)
