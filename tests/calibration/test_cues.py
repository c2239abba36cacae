"""Calibration where people speak of one cue at a time: boxes of one, three and seven entries, choices in a row."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.calibration import CHANGED, Calibration, calibrate
from cuelearner_jax.calibration.families import declared_distortions
from cuelearner_jax.calibration.likelihood import log_chance, log_chances
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import human_answer
from cuelearner_jax.spaces import UNSAID, Box, Choices, Cue

GEARS = Choices(9, Cue("gear", ("higher", "lower"), ("PageUp", "PageDown"), "steps"))
BOXES = {size: Box((-1.0,) * size, (1.0,) * size) for size in (1, 3, 7)}


class Room(WholeObservations):
    """What is seen means nothing to a person who knows what to do, and no number of it is in metres."""

    observation = (Quantity("context", 2, "1"),)

    def __init__(self, actions):
        self.actions = actions


def acts(space, obs):
    """A policy of what it sees."""
    if space.grain:
        return jax.vmap(lambda change: space.exp(jnp.eye(9)[4], change))(jnp.round(obs[:, :1]))
    shares = jnp.stack([0.2 * jnp.sin(entry + obs[:, 0] * obs[:, 1]) for entry in range(space.size)], -1)
    return space.exp(jnp.broadcast_to(space.spread(1), shares.shape), shares)


def situations(key, policy, count):
    return None, jax.random.uniform(key, (count, 2), minval=-1.5, maxval=1.5)


chances = jax.jit(log_chances)


def asked(space, change, says, labels):
    """What calibration finds where a teacher, who speaks of such cues, wants actions changed by a constant."""
    eps = 1.0 if space.grain else 0.04
    policy = jax.jit(partial(acts, space))
    meant = jax.jit(lambda obs: space.exp(policy(obs), jnp.array(change)))
    scalars = dataclasses.replace(Scalars(), eps_deg=eps, says=says)

    @jax.jit
    def answer(keys, obs, actions):
        say = lambda key, action, best: human_answer(key, space, action, best, scalars)[0]  # noqa: E731
        return jax.vmap(say)(keys, actions, meant(obs))

    def teacher(key, states, obs, actions):
        told = answer(jax.random.split(key, len(obs)), obs, actions)
        assert says == "all" or (np.sum(np.asarray(told) != UNSAID, 1) == 1).all()
        return told

    found = calibrate(
        policy,
        declared_distortions(Room(space)),
        situations,
        teacher,
        labels,
        jax.random.key(1),
        space=space,
        eps_deg=eps,
    )
    obs = situations(jax.random.key(9), None, 100)[1]
    log = jax.jit(space.log)
    left = np.abs(log(found.policy.act(jax.random.key(0), None, obs), meant(obs))).mean()
    return found.verdict, left / np.abs(log(policy(obs), meant(obs))).mean()


CHANGES = {1: [0.15], 3: [0.15, -0.1, 0.0], 7: [0.15, 0.0, -0.1, 0.0, 0.1, 0.0, -0.05]}


@pytest.mark.parametrize(
    ("size", "says", "labels", "most"),
    [
        (1, "all", 60, 0.1),
        pytest.param(3, "one", 50, 0.35, marks=pytest.mark.long),
        pytest.param(3, "worst", 100, 0.2, marks=pytest.mark.long),
        pytest.param(7, "one", 100, 0.4, marks=pytest.mark.long),
    ],
)
def test_a_constant_change_is_found_from_words_about_one_cue_at_a_time(size, says, labels, most):
    verdict, left = asked(BOXES[size], CHANGES[size], says, labels)
    assert verdict == CHANGED
    assert left < most


@pytest.mark.long
def test_a_change_by_two_steps_of_a_row_of_choices_is_found():
    assert asked(GEARS, [2.0], "all", 40) == (CHANGED, 0.0)


def test_an_answer_is_as_likely_as_what_it_says_of_the_cues_it_speaks_of():
    offset, spread = jnp.array([[1.0, -3.0, 0.2]]), jnp.zeros((1, 3))
    answer, doubt = jnp.array([[1.0, UNSAID, UNSAID]]), jnp.zeros(1)
    alone = chances(offset[:, :1], spread[:, :1], answer[:, :1], jnp.ones((1, 1)), doubt)
    told = chances(offset, spread, answer, jnp.array([[1.0, 0.0, 0.0]]), doubt)
    np.testing.assert_allclose(told, alone, rtol=1e-5)
    far = chances(offset.at[0, 1:].set(9.0), spread, answer, jnp.array([[1.0, 0.0, 0.0]]), doubt)
    np.testing.assert_array_equal(told, far)


def test_answers_together_are_as_likely_as_the_product_of_each():
    random = np.random.default_rng(0)  # 33 factors, so that the last group of eight is not full
    offset, spread = (jnp.asarray(9 * random.random((2, 11, 3)), jnp.float32) for _ in range(2))
    answer, told = random.integers(-1, 2, (11, 3)) * 1.0, random.integers(0, 2, (11, 3)) * 1.0
    rows = offset, spread, jnp.asarray(answer), jnp.asarray(told), jnp.asarray(random.random(11))
    np.testing.assert_allclose(jax.jit(log_chance)(*rows), chances(*rows).sum(1), rtol=1e-5)


def test_an_answer_that_says_nothing_is_no_answer():
    space = BOXES[3]
    calibration = Calibration(jax.jit(partial(acts, space)), declared_distortions(Room(space)), space, 0.04)
    obs = np.asarray(situations(jax.random.key(0), None, 5)[1])
    calibration.learn(obs, np.asarray(space.sample(jax.random.key(0), (5,))), np.full((5, 3), UNSAID))
    assert calibration.asked == 0
    with pytest.raises(UserError, match="0 answers are too few"):
        calibration.result()
