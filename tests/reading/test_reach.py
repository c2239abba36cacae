"""A reach in a box of three: what changed is found with its interval from 48 labels, and nothing where nothing did.

All tests share the shape of their labels, and so their compiled programs.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.reading import Reading, fitting
from cuelearner_jax.reading.linear import RelativeLabels
from cuelearner_jax.reading.result import _of_action, describe_fit
from cuelearner_jax.spaces import Box, Choices, Cue

LABELS, BATCHES, OBS, EPS = 48, 3, 8, 0.05
BOX = Box((-1.0,) * 3, (1.0,) * 3)
ASIDE = np.array([0.25, 0.15, 0, 0, 0, 0, 0, 0], np.float32)


@jax.jit
def policy(obs):
    """Move toward the goal: the first three entries, less the next three. There is no action beyond 1 in the last."""
    return jnp.where(jnp.abs(obs[:, 7:]) <= 1, jnp.clip(4 * (obs[:, :3] - obs[:, 3:6]), -1.0, 1.0), jnp.nan)


def near(seed, count=40, away=0.25):
    """Situations with goals so far away; the last two entries are of no use."""
    random = np.random.default_rng(seed)
    obs = random.uniform(-1, 1, (count, OBS)).astype(np.float32)
    obs[:, :3] = obs[:, 3:6] + random.uniform(-away, away, (count, 3))
    return obs


def moved(obs, factor=1.0, change=0.0):
    return np.clip(np.asarray(policy(obs)) * np.float32(factor) + np.float32(change), -1, 1)


def read(right, policy=policy, within=0.5, first=0, **how):
    """Read labels about a policy; `right`: observations -> right actions; None: answers are random.

    `within`: distance in `EPS` up to which an action is called right. `first`: seed of the first situations.
    """
    reading = Reading(policy, (), BOX, EPS, LABELS)
    for batch in range(BATCHES):
        obs = near(first + batch, **how)
        index, action = reading.questions(obs, LABELS // BATCHES, jax.random.key(batch))
        answer = np.random.default_rng((batch, 1)).integers(-1, 2, action.shape).astype(np.float32)
        if right is not None:
            change = np.asarray(BOX.log(action, right(obs[index])))
            answer = np.where(np.abs(change) <= within * EPS, 0.0, np.sign(change))
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


def test_entries_that_are_seen_mixed_are_told_as_such():
    """By the last hypothesis without a process, which may explain the answers as well."""
    turn = np.eye(OBS, dtype=np.float32)
    turn[:2, :2] = [[0.88, 0.48], [-0.48, 0.88]]  # of the goal alone
    reading = read(lambda obs: moved(obs @ turn))
    fit = fitting.pick(reading.fits, len(fitting.HYPOTHESES) - 1)
    mixed = describe_fit(fit, BOX, (), EPS, (), np.zeros((0, OBS + 3)))[1]
    assert mixed == pytest.approx(0.19, rel=0.2)
    words = reading.result()._replace(changed=True, mixed=mixed).words()
    assert f"entries of the observation are seen mixed, which moves actions by {mixed:.3g} typically" in words


def test_where_nothing_is_wrong_actions_stay_bitwise_as_they_were():
    reading = read(moved)
    result, obs = reading.result(), near(99)
    assert (result.used, result.changed, result.words()) == (False, False, ["The answers ask for no change."])
    new, own = Reading(policy, (), BOX, EPS, LABELS), result.policy.correction
    change = own.change.replace(theta=own.change.theta.at[7].set(-3.0))  # undone, it leaves where the policy acts
    for unchanged in (result.policy, result.policy.replace(correction=own.replace(change=change)), new.policy()):
        np.testing.assert_array_equal(unchanged.act(jax.random.key(0), None, jnp.asarray(obs)), policy(obs))
    new.questions(obs, 1, jax.random.key(0))
    np.testing.assert_array_equal(new.policy().act(jax.random.key(0), None, jnp.asarray(obs)), policy(obs))
    with pytest.raises(UserError, match="actions that are not finite"):
        new.learn(obs + 2, moved(obs), moved(obs))
    fit = reading.fit.replace(hypothesis=reading.fit.hypothesis.replace(change=change))
    assert np.isfinite(reading._reader.spread(fit, jnp.asarray(obs[:16]))).all()
    assert reading._reader._frame(RelativeLabels(*map(jnp.asarray, reading.rows)))[1].all()
    assert fit.frame.mixed[0] != 7  # on which no action depends


def test_a_teacher_who_calls_much_right_asks_for_no_change():
    assert read(moved, within=1.5, first=300).result().words() == ["The answers ask for no change."]


def test_random_answers_use_no_correction():
    assert not read(None, policy=lambda obs: np.asarray(policy(obs))).result().used
    jumping = jax.jit(lambda obs: jnp.sign(jnp.sin(1e4 * obs.sum(1, keepdims=True))) * jnp.ones((1, 3)))
    assert read(None, policy=jumping).result().words() == ["The answers ask for no change."]


def test_questions_stay_within_a_bound():
    reading, obs = Reading(policy, (), BOX, EPS, LABELS, bound_deg=EPS), near(0)
    index, action = reading.questions(obs, 40, jax.random.key(0))
    assert np.abs(BOX.log(policy(obs[index]), action)).max() == pytest.approx(EPS, abs=1e-5)
    bounded = reading.policy().replace(bound=jnp.float32([EPS, 1.0])).describe()  # of two lanes
    assert (bounded["bounded"], bounded["clip_radius_deg"]) == (True, 1.0)


def test_of_wide_observations_no_array_is_large():
    reader, (plain, _) = fitting.Reader(BOX, (), lambda obs: obs[:, :3], EPS), fitting.unfitted(BOX, (), 1024)

    def linearised(obs, action):
        labels = RelativeLabels(obs, action, action, jnp.ones(100, bool))
        frame, _ = reader._frame(labels)
        return reader._data(frame, labels, action, reader._start(frame, labels, plain).change)

    traced = jax.make_jaxpr(linearised)(jnp.zeros((100, 1024)), jnp.zeros((100, 3)))
    assert max(value.aval.size for step in traced.eqns for value in step.outvars) < 2**26  # 256 MiB


def test_of_choices_the_entry_that_matters_is_told():
    gear = Choices(6, Cue("gear", ("higher", "lower"), (), "steps"))
    *_, last = _of_action(np.ones(7), np.zeros((7, 1)), np.ones((4, 7)), gear, 1.0)
    assert last.name == "action: gear, times entry 6 of the action"


def test_a_cue_of_which_all_answers_name_the_same_way_is_told():
    reading, obs = Reading(policy, (), BOX, EPS, LABELS), near(0, LABELS)
    reading.learn(obs, moved(obs), np.tile(np.float32([[1, -1, 0], [-1, -1, 1]]), (LABELS // 2, 1)))
    assert reading.result().open_ended == (f"all 48 answers about {BOX.cues[1].name} say {BOX.cues[1].words[1]}",)
