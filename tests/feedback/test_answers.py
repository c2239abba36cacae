"""What teachers answer in each form, by hand: of their best action or of the nearest good one, with their faults."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from box_task import SMALL
from flax import struct

from cuelearner_jax.config import Scalars
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import DEMONSTRATION, PREFERENCE, RELATIVE, SCALAR, check_teacher, human_answer
from cuelearner_jax.spaces import DIRECTIONS, UNSAID, Box, Choices, cues_from, directions
from cuelearner_jax.types import ValuesDirections

FORMS = {"relative": RELATIVE, "demonstration": DEMONSTRATION, "scalar": SCALAR}
ENV = probes.Window(half_width=math.radians(10.0), offset=math.radians(50.0))
SCALARS = Scalars(eps_deg=10.0, nearest_aim_deg=0.0)
X = jnp.array([1.0, 0.0])
KEY = jax.random.key(3)


@struct.dataclass
class TwoWindows:
    """Holds 50 degrees for best and 95 to 105, worth 0.7 of that, for good."""

    def best_action(self, state, obs):
        return directions.from_angle(jnp.deg2rad(50.0))

    def nearest_good(self, state, obs, action, spread, share):
        degrees = jnp.arange(360.0)
        values = jnp.where(degrees == 50, 1.0, jnp.where(jnp.abs(degrees - 100) <= 5, 0.7, 0.0))
        return directions.nearest_direction(values, spread, share, action)


def direction(degrees):
    return directions.from_angle(jnp.deg2rad(jnp.float32(degrees)))


@jax.jit
def said(scalars, action, keys):
    """Answers of every form to one question, asked again and again."""

    def one(key):
        return {name: form.answer(key, ENV, TwoWindows(), X, X, action, scalars) for name, form in FORMS.items()}

    return jax.vmap(one)(keys)


def answers(action_deg, **changes):
    """Of the forms: h; the angle shown [deg]; good or not."""
    found = said(dataclasses.replace(SCALARS, **changes), direction(action_deg), jax.random.split(jax.random.key(0), 1))
    h, shown, good = (np.asarray(found[name][0][0]) for name in FORMS)
    assert all(bool(found[name][1][0]) for name in FORMS)
    return float(h[0]), round(float(np.degrees(directions.to_angle(shown))), 2), float(good[0])


@pytest.mark.parametrize(
    ("action_deg", "best", "nearest"),
    [
        (0, (1, 50, 0), (1, 50, 0)),
        (46, (0, 50, 1), (0, 50, 1)),  # within eps / 2; within 5 degrees
        (44, (1, 50, 0), (1, 50, 0)),
        (80, (-1, 50, 0), (1, 95, 0)),  # the nearest good one lies the other way
        (91, (-1, 50, 0), (0, 95, 1)),
        (100, (-1, 50, 0), (0, 100, 1)),  # good already
        (120, (-1, 50, 0), (-1, 105, 0)),
        (-150, (-1, 50, 0), (-1, 105, 0)),  # -160 and -105 the short way
    ],
)
def test_answers_by_hand(action_deg, best, nearest):
    assert answers(action_deg) == best
    assert answers(action_deg, answer="nearest") == nearest
    assert answers(action_deg, answer="nearest", nearest_share=0.8) == best  # the best one alone is good


FAULTS = {
    "mistaken": ({"mistake_probability": 1.0}, (-1, -50, 1), (0, 42, 0)),  # near: 4 degrees off, as much the other way
    "biased": ({"teacher_bias_deg": -40.0}, (1, 10, 0), (-1, 10, 0)),
    "indifferent": ({"indifference_deg": 45.0}, (1, 50, 0), (0, 46, 1)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_mean_something_in_every_form(fault):
    changes, far, near = FAULTS[fault]
    assert answers(0, **changes) == far
    assert answers(46, **changes) == near


def test_a_biased_teacher_looks_for_the_nearest_good_one_where_it_takes_it_to_be():
    # All turned by -40: 10 is held for best, 55 to 65 for good.
    changes = {"answer": "nearest", "teacher_bias_deg": -40.0}
    assert [answers(angle, **changes)[1] for angle in (0, 30, 40, 60, 80)] == [10, 10, 55, 60, 65]


def test_faults_come_with_their_probabilities_and_independently_in_every_form():
    scalars = dataclasses.replace(SCALARS, mistake_probability=0.3, silence_probability=0.2)
    found = said(scalars, X, jax.random.split(jax.random.key(0), 2000))
    mistaken = {
        "relative": found["relative"][0][:, 0] < 0,
        "demonstration": found["demonstration"][0][:, 1] < 0,
        "scalar": found["scalar"][0][:, 0] > 0,
    }
    for name in FORMS:
        wrong, answered = np.asarray(mistaken[name]), np.asarray(found[name][1])
        assert wrong.mean() == pytest.approx(0.3, abs=0.05)  # standard deviation 0.01
        assert answered.mean() == pytest.approx(0.8, abs=0.05)
        assert wrong[answered].mean() == pytest.approx(0.3, abs=0.06)


@pytest.mark.parametrize(
    ("pair_deg", "faults", "choice"),
    [
        ((0, 80), {}, 1),  # 50 and 30 degrees from the best
        ((80, 0), {}, -1),
        ((46, 60), {}, -1),  # 4 and 10
        ((46, 58), {}, 0),  # 4 and 8: they differ by less than eps / 2
        ((20, 80), {}, 0),  # as far on either side
        ((46, 60), {"indifference_deg": 7.0}, 0),
        ((0, 80), {"mistake_probability": 1.0}, -1),
        ((20, 80), {"mistake_probability": 1.0}, 0),
        ((0, 80), {"teacher_bias_deg": -40.0}, -1),  # 10 is held for best
        ((80, 100), {"answer": "nearest"}, 1),  # 95 is good, and nearer to 80 than 50 is
    ],
)
def test_of_two_actions_the_nearer_one_is_preferred(pair_deg, faults, choice):
    one, other = map(direction, pair_deg)
    scalars = dataclasses.replace(SCALARS, **faults)
    answer, answered = jax.jit(PREFERENCE.answer)(KEY, ENV, TwoWindows(), X, X, one, scalars, other)
    np.testing.assert_allclose(answer, [choice, *other], atol=1e-6)
    assert bool(answered)


def test_a_pair_is_drawn_far_and_near_and_faults_come_with_their_probabilities():
    scalars = dataclasses.replace(SCALARS, mistake_probability=0.3, silence_probability=0.2)
    ask = lambda key: PREFERENCE.answer(key, ENV, TwoWindows(), X, X, X, scalars)  # noqa: E731
    answers, answered = jax.jit(jax.vmap(ask))(jax.random.split(KEY, 2000))
    second = np.asarray(answers)[:, 1:]
    gain = 50 - np.degrees(DIRECTIONS.distance(second, direction(50)))
    assert answered.mean() == pytest.approx(0.8, abs=0.05)
    clear = np.abs(gain) > 5.1
    away = np.degrees(DIRECTIONS.distance(X, second))
    for rows in (clear & (away < 30), clear & (away > 30)):  # mistakes do not depend on the pair
        assert (np.sign(gain) != answers[:, 0])[rows].mean() == pytest.approx(0.3, abs=0.07)  # standard deviation 0.02
    np.testing.assert_array_equal(answers[:, 0][np.abs(gain) < 4.9], 0)
    assert np.quantile(away, 0.25) < 20
    assert np.quantile(away, 0.85) > 60
    fruit = Choices(3)  # of choices without an order there is no near one
    drawn = jax.vmap(lambda key: PREFERENCE.second(key, fruit, jnp.eye(3)[0], scalars))(jax.random.split(KEY, 300))
    np.testing.assert_allclose(drawn.mean(0), 1 / 3, atol=0.12)  # standard deviation 0.027


def test_who_knows_the_best_action_alone_cannot_tell_the_nearest_good_one():
    nearest = dataclasses.replace(SCALARS, answer="nearest")
    assert isinstance(TwoWindows(), ValuesDirections)
    check_teacher(TwoWindows(), nearest)
    check_teacher(probes.Expert(ENV), SCALARS)
    with pytest.raises(UserError, match=r"give --scalars\.answer best") as refusal:
        check_teacher(probes.Expert(ENV), nearest)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("change", "all_cues", "worst"),
    [
        ((0.2, -0.3, 0.1), (1, -1, 1), (None, -1, None)),
        ((0.3, -0.3, 0.1), (1, -1, 1), (1, None, None)),  # as far along both: the first
        ((0.02, -0.01, 0.04), (0, 0, 0), (None, None, 0)),  # all are right: the worst is, and of the others not a word
        ((0.0, 0.0, 0.0), (0, 0, 0), (0, None, None)),
        ((0.02, 0.0, -0.3), (0, 0, -1), (None, None, -1)),
    ],
)
def test_a_teacher_of_the_worst_cue_says_nothing_of_the_others(change, all_cues, worst):
    """Differences in quarters of eps and more of a box whose ranges are 2, 4 and 2: shares, not metres, decide."""
    action = jnp.array([0.0, 2.0, -1.0])
    best = SMALL.exp(action, jnp.array(change, jnp.float32))
    key = jax.random.key(0)
    for says, expected in (("all", all_cues), ("worst", worst)):
        answer, answered = human_answer(key, SMALL, action, best, dataclasses.replace(SCALARS, eps_deg=0.1, says=says))
        np.testing.assert_array_equal(answer, [UNSAID if h is None else h for h in expected])
        assert bool(answered)


def test_a_teacher_of_one_cue_speaks_of_each_as_often_and_rightly():
    action = jnp.array([0.0, 2.0, -1.0])
    best = SMALL.exp(action, jnp.array([0.2, -0.3, 0.0]))
    scalars = dataclasses.replace(SCALARS, eps_deg=0.1, says="one")
    keys = jax.random.split(jax.random.key(0), 900)
    answers, answered = jax.vmap(lambda key: human_answer(key, SMALL, action, best, scalars))(keys)
    told = np.asarray(answers) != UNSAID
    assert answered.all()
    np.testing.assert_array_equal(told.sum(1), 1)
    np.testing.assert_allclose(told.mean(0), 1 / 3, atol=0.07)  # standard deviation 0.016
    for cue, h in enumerate((1, -1, 0)):
        np.testing.assert_array_equal(np.asarray(answers)[told[:, cue], cue], h)


@pytest.mark.parametrize("says", ["all", "worst", "one"])
def test_no_teacher_speaks_of_a_cue_that_people_are_not_asked_about(says):
    space = Box((-1.0, -1.0), (1.0, 1.0), cues_from("x=left,right", ("x", "y")))
    scalars = dataclasses.replace(SCALARS, eps_deg=0.1, says=says)
    answer = lambda key: human_answer(key, space, jnp.zeros(2), jnp.array([0.0, 1.0]), scalars)  # noqa: E731
    answers, answered = jax.vmap(answer)(jax.random.split(KEY, 9))
    np.testing.assert_array_equal(answers, [[0, UNSAID]] * 9)
    assert answered.all()
