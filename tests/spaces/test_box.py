"""Boxes of three and seven entries: laws by hand, answers about each entry, refinement, label files, a guide fitted."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from box_task import EPS, SCALARS, SMALL

from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import RELATIVE, human_answer, relative_feedback
from cuelearner_jax.spaces import UNSAID, Box, Cue, cues_from, from_json
from cuelearner_jax.storage import label_files
from cuelearner_jax.types import Label

LARGE = Box((-1.0,) * 7, tuple(1.0 + 0.5 * entry for entry in range(7)))
KEY = jax.random.key(3)
boxes = pytest.mark.parametrize("box", [SMALL, LARGE], ids=["three", "seven"])


def pairs(box, count=64):
    """Actions and as many others."""
    return box.sample(jax.random.key(0), (count,)), box.sample(jax.random.key(1), (count,))


@boxes
def test_what_log_says_exp_goes(box):
    action, other = pairs(box)
    assert action.shape == (64, box.size)
    np.testing.assert_allclose(box.exp(action, box.log(action, other)), other, atol=1e-5)
    np.testing.assert_array_equal(box.log(action, action), 0)
    low, high = np.array(box.low), np.array(box.high)
    np.testing.assert_allclose(box.log(low, high), np.ones(box.size), rtol=1e-6)  # shares of the range
    np.testing.assert_allclose(box.exp(low, 3.0 * jnp.ones(box.size)), high)  # no farther than the bound


@boxes
def test_retract_gives_the_nearest_action_and_leaves_actions_alone(box):
    action, _ = pairs(box)
    low, high = np.array(box.low, np.float32), np.array(box.high, np.float32)
    np.testing.assert_array_equal(box.retract(action), action)
    np.testing.assert_array_equal(box.retract(jnp.stack([low - 5, high + 5])), [low, high])
    np.testing.assert_array_equal(box.retract(box.retract(3 * action)), box.retract(3 * action))
    lost = np.asarray(box.retract(action.at[0, 1].set(jnp.nan).at[1, 0].set(jnp.inf)))
    assert np.isnan(lost[[0, 1], [1, 0]]).all()
    assert np.isnan(lost).sum() == 2


@boxes
def test_clip_and_approach_go_no_farther_than_the_bound_along_any_entry(box):
    action, base = pairs(box)
    clipped = box.clip(action, base, 0.25)
    assert np.abs(box.log(base, clipped)).max() <= 0.25 + 1e-6
    for bound in (0.0, 0.25, 1.0):
        expected = np.clip(box.log(action, base), -bound, bound)
        np.testing.assert_allclose(box.log(action, box.approach(action, base, bound)), expected, atol=1e-5)
    inside = np.asarray(box.distance(base, action)) <= 0.5
    assert 0 < inside.sum() < 64 or box is LARGE
    np.testing.assert_array_equal(np.asarray(box.clip(action, base, 0.5))[inside], np.asarray(action)[inside])
    np.testing.assert_array_equal(box.clip(action, base, 1.0), action)


@boxes
def test_samples_and_the_even_spread_fill_the_box(box):
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


@pytest.mark.parametrize(
    ("change", "h"),
    [
        ((0, 0, 0.3), (0, 0, 1)),  # wrong in its third entry alone
        ((0, 0, -0.3), (0, 0, -1)),
        ((0.04, -0.04, 0), (0, 0, 0)),  # right within eps / 2
        ((0.06, -0.06, 0.04), (1, -1, 0)),
        ((-0.3, 0.3, 0.3), (-1, 1, 1)),
    ],
)
def test_a_relative_answer_says_of_each_entry_which_way(change, h):
    action = SMALL.spread(1)[0]
    best = SMALL.exp(action, jnp.array(change, jnp.float32))
    np.testing.assert_array_equal(relative_feedback(SMALL, action, best, EPS), h)
    answer, answered = human_answer(KEY, SMALL, action, best, SCALARS)
    np.testing.assert_array_equal(answer, h)
    assert bool(answered)
    np.testing.assert_allclose(SMALL.log(action, SMALL.toward(action, answer, EPS)), EPS * np.array(h), atol=1e-6)


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
    unsaid = LARGE.toward(action, jnp.full(7, UNSAID), EPS)
    np.testing.assert_array_equal(unsaid, action)


def test_a_label_file_holds_answers_about_a_box(tmp_path):
    action, _ = pairs(SMALL, 12)
    given = np.array(list(itertools.islice(itertools.product((-1, 0, 1, UNSAID), repeat=3), 12)), np.float32)
    labels = Label(np.zeros((1, 12, 2), np.float32), action[None], given[None], np.ones((1, 12), bool))
    path, meaning = tmp_path / "labels.parquet", RELATIVE.meaning(SMALL)
    label_files.write(path, {"name": "reach"}, "relative", SMALL, EPS, np.array([4]), labels, meaning)
    file = label_files.read(path)
    assert (file.space, file.answers, file.eps) == (SMALL, "relative", EPS)
    np.testing.assert_array_equal(file.labels.action, action)
    np.testing.assert_array_equal(file.labels.answer, given)
    external_labels.check_file(file, None, RELATIVE, "labels.parquet")
    spoilt = file._replace(labels=file.labels.replace(action=file.labels.action + np.float32([5, 0, 0])))
    with pytest.raises(UserError, match="vectors between the bounds"):
        external_labels.check_file(spoilt, None, RELATIVE, "labels.parquet")


@pytest.mark.parametrize("size", [9, 28])
def test_boxes_of_bimanual_arms_and_hands_need_no_cues_and_no_keys(size):
    plain = Box((-1.0,) * size, (1.0,) * size)
    assert [cue.name for cue in plain.cues][::8] == [f"entry {number}" for number in range(1, size + 1, 8)]
    named = Box(plain.low, plain.high, cues_from(";".join(f"more{entry},less{entry}" for entry in range(size))))
    for box in (plain, named):
        keys = [key for cue in box.cues for key in cue.keys]
        assert len(keys) == len(set(keys)) > 16
        assert from_json(box.to_json()) == box
        np.testing.assert_allclose(box.exp(*map(jnp.asarray, (box.low, np.ones(size)))), box.high)
