"""A reach in a box of three: what changed is found with its interval from 48 labels, and nothing where nothing did.

All tests share the shape of their labels, and so their compiled programs.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.reading import Reading
from cuelearner_jax.spaces import Box

LABELS, BATCHES, OBS, EPS = 48, 3, 8, 0.05
BOX = Box((-1.0,) * 3, (1.0,) * 3)
ASIDE = np.array([0.25, 0.15, 0, 0, 0, 0, 0, 0], np.float32)


@jax.jit
def policy(obs):
    """Move toward the goal: the first three entries, less the next three."""
    return jnp.clip(4 * (obs[:, :3] - obs[:, 3:6]), -1.0, 1.0)


def near(seed, count=40, away=0.25):
    """Situations with goals so far away; the last two entries are of no use."""
    random = np.random.default_rng(seed)
    obs = random.uniform(-1, 1, (count, OBS)).astype(np.float32)
    obs[:, :3] = obs[:, 3:6] + random.uniform(-away, away, (count, 3))
    return obs


def moved(obs, factor=1.0, change=0.0):
    return np.clip(np.asarray(policy(obs)) * np.float32(factor) + np.float32(change), -1, 1)


def read(right, **how):
    """Read labels about the policy; `right`: observations -> right actions; None: answers are random."""
    reading = Reading(policy, (), BOX, EPS, LABELS)
    for batch in range(BATCHES):
        obs = near(batch, **how)
        index, action = reading.questions(obs, LABELS // BATCHES, jax.random.key(batch))
        answer = np.random.default_rng((batch, 1)).integers(-1, 2, action.shape).astype(np.float32)
        if right is not None:
            change = np.asarray(BOX.log(action, right(obs[index])))
            answer = np.where(np.abs(change) <= EPS / 2, 0.0, np.sign(change))
        reading.learn(obs[index], action, answer)
    return reading


def error(act, right, **how):
    """Mean distance from the right actions, in shares of the range."""
    obs = near(99, LABELS, **how)
    return np.abs(BOX.log(act(jnp.asarray(obs)), right(obs))).mean()


@pytest.mark.parametrize(
    ("right", "truth", "away"),
    [
        (
            lambda obs: moved(obs, change=[0.2, -0.15, 0.1]),
            {"action: entry 1": 0.1, "action: entry 2": -0.075, "action: entry 3": 0.05},
            0.25,
        ),
        (
            lambda obs: moved(obs, factor=[0.35, 1.0, -0.3]),
            {"action: entry 1: gain": 35.0, "action: entry 3: gain": -30.0},
            0.25,
        ),
        (  # so far from the goal that actions are at their bounds: there a shift of the action is something else
            lambda obs: moved(obs - ASIDE),
            {"obs[0] - obs[3] seen aside": 0.25, "obs[1] - obs[4] seen aside": 0.15},
            0.6,
        ),
    ],
    ids=["constant", "gains", "aside"],
)
def test_a_change_is_corrected_and_its_interval_holds_the_truth(right, truth, away):
    reading = read(right, away=away)
    result = reading.result()
    assert result.used, result
    assert error(reading.act, right, away=away) < 0.1 * error(policy, right, away=away)
    found = {one.name: one for one in result.estimates}
    assert found.keys() == truth.keys()
    for name, value in truth.items():
        assert found[name].low <= value <= found[name].high, found[name].words()


def test_where_nothing_is_wrong_actions_stay_bitwise_as_they_were():
    reading = read(moved)
    result, obs = reading.result(), near(99)
    assert (result.used, result.changed, result.words()) == (False, False, ["The answers ask for no change."])
    np.testing.assert_array_equal(result.policy.act(jax.random.key(0), None, jnp.asarray(obs)), policy(obs))


def test_random_answers_use_no_correction():
    assert not read(None).result().used


def test_a_cue_of_which_all_answers_name_the_same_way_is_told():
    reading, obs = Reading(policy, (), BOX, EPS, LABELS), near(0, LABELS)
    reading.learn(obs, moved(obs), np.tile(np.float32([[1, -1, 0], [-1, -1, 1]]), (LABELS // 2, 1)))
    assert reading.result().open_ended == (f"all 48 answers about {BOX.cues[1].name} say {BOX.cues[1].words[1]}",)
