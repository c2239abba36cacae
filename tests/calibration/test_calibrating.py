"""Worlds whose truth is known: what changed is named, with an interval that holds it, and nothing else is touched."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_worlds import BOX, Yard, aims, changed, grips, person, situations

from cuelearner_jax.calibration import CHANGED, UNCHANGED, UNEXPLAINED, Calibration, calibrate, confirmation
from cuelearner_jax.calibration.families import declared_distortions
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import policy_of
from cuelearner_jax.spaces import DIRECTIONS, Choices, Space
from cuelearner_jax.spaces.directions import rotate

EPS_DEG = 2.0
# Once, so that programs are compiled once: shifted places, a turned lidar, a turned action.
FAMILY, POLICY = (
    tuple(one for one in declared_distortions(Yard()) if one.name != "wind: turn"),
    policy_of(jax.jit(aims)),
)
TURN = FAMILY[-1:]
EPS = float(np.deg2rad(EPS_DEG))
TURNED = jax.jit(lambda obs: rotate(aims(obs), -jnp.deg2rad(30.0)))
SHIFTED = lambda obs: aims(changed(obs, shift=(0.05, -0.03)))  # noqa: E731


def asked(meant, labels=50, wrong=0.0, policy=POLICY, family=FAMILY, seed=0):
    answers = person(DIRECTIONS, EPS, meant, wrong)
    key = jax.random.key(seed)
    return calibrate(policy, family, situations, answers, labels, key, space=DIRECTIONS, eps_deg=EPS_DEG)


def missed(found, meant, space: Space = DIRECTIONS):
    """Mean distance from the corrected policy to what is meant, in the space's unit."""
    _, obs = situations(jax.random.key(99), None, 200)
    away = jnp.abs(space.log(found.policy.act(jax.random.key(0), None, obs), meant(obs)))
    return float(jnp.mean(space.to_unit(away)))


def estimates(found):
    return {one.name: one for one in found.estimates}


@pytest.mark.long
def test_a_python_function_turned_by_30_degrees_is_put_right_by_50_answers():
    found = asked(TURNED, policy=lambda obs: np.asarray(aims(obs)), family=TURN)
    assert (found.verdict, found.changes) == (CHANGED, ("direction: change",))
    turn = estimates(found)["direction: turn"]
    assert abs(turn.mean - 30) < 1.5
    assert turn.low < 30.5
    assert turn.high > 29.5
    assert missed(found, TURNED) < 1.5


@pytest.mark.long
def test_shifted_places_are_told_from_a_turned_action():
    found = asked(SHIFTED)
    assert "ball and 1 more: shift" in found.changes
    assert missed(found, SHIFTED) < 0.25 * missed(found._replace(policy=POLICY), SHIFTED)


@pytest.mark.long
def test_one_answer_in_five_may_be_wrong():
    found = asked(TURNED, labels=80, wrong=0.2, family=FAMILY[1:])
    assert found.changes == ("direction: change",)
    assert missed(found, TURNED) < 2
    assert 0.05 < found.wrong < 0.45


def test_no_change_is_told_and_nothing_is_corrected():
    found = asked(aims, family=FAMILY[1:])
    assert (found.verdict, found.changes) == (UNCHANGED, ())
    assert found.confirmed is None  # policy and teacher agree: no label was spent on confirming
    for one in found.estimates:  # 95% of intervals hold zero, and here all that are half as wide again
        more = 0.25 * (one.high - one.low)
        assert one.low - more < 0 < one.high + more
    assert missed(found, aims) < 1e-4


def test_a_change_outside_the_family_is_told_and_nothing_is_corrected():
    side = jax.jit(lambda obs: rotate(aims(obs), jnp.where(jnp.sin(40 * obs[:, 1]) > 0, 0.5, -0.5)))
    found = asked(side, family=FAMILY[1:])
    assert (found.verdict, found.changes) == (UNEXPLAINED, ())
    assert found.confirmed is not None
    assert missed(found, aims) < 1e-4
    assert "None of these" in found.words()[0]


@pytest.mark.long
def test_a_biased_teacher_is_told_from_a_change_of_the_world_where_that_is_asked_for():
    meant = lambda obs: rotate(SHIFTED(obs), jnp.deg2rad(8.0))  # noqa: E731
    found = asked(meant, labels=80, family=(FAMILY[0], declared_distortions(Yard(), teacher_bias=True)[-1]))
    assert found.changes == ("ball and 1 more: shift",)
    assert abs(estimates(found)["teacher: turn"].mean - 8) < 2
    assert missed(found, SHIFTED) < 2


@pytest.mark.long
def test_a_box_is_calibrated_cue_by_cue():
    eps = 0.05
    meant = lambda obs: BOX.exp(grips(obs), jnp.array([0.2, 0.0, -0.1]))  # noqa: E731
    family = [one for one in declared_distortions(Yard(BOX)) if one.acts]
    found = calibrate(
        jax.jit(grips), family, situations, person(BOX, eps, meant), 60, jax.random.key(0), space=BOX, eps_deg=eps
    )
    assert found.changes == (family[0].name,)
    assert missed(found, meant, BOX) < eps / 2


def test_questions_of_a_batch_tell_different_things():
    calibration = Calibration(POLICY, TURN, DIRECTIONS, EPS_DEG)
    _, obs = situations(jax.random.key(0), None, 60)
    questions = calibration.questions(obs, 10)
    assert len(set(questions.index.tolist())) == 10
    assert questions.action.shape == (10, 2)
    turns = np.rad2deg(np.asarray(DIRECTIONS.log(np.asarray(aims(obs))[questions.index], questions.action))[:, 0])
    assert np.ptp(turns) > 10  # the turn is not known: asked are actions turned by more and by less
    assert questions.information[0] > 2 * questions.information[-1]


@pytest.fixture(scope="module")
def turned():
    """A calibration that 30 answers have told of a turn, and situations for more."""
    calibration, answers = Calibration(POLICY, TURN, DIRECTIONS, EPS_DEG), person(DIRECTIONS, EPS, TURNED)
    _, obs = situations(jax.random.key(0), None, 100)
    for start in (0, 15):
        asked = calibration.questions(obs[start : start + 15], 15)
        rows = obs[start + asked.index], asked.action
        calibration.learn(*rows, answers(jax.random.key(start), None, *rows))
    return calibration, obs[30:]


def test_confirmations_are_halfway_and_answers_count_by_their_side(turned):
    calibration, obs = turned[0].copy(np.random.default_rng(0)), turned[1]
    asked = calibration.confirmations(obs, 10)
    halfway = np.rad2deg(DIRECTIONS.log(aims(obs)[asked.index], asked.action))
    assert np.allclose(halfway, -15, atol=2)  # the right actions are 30 degrees to the right
    told = np.array([-1, -1, -1, -1, -1, -1, 1, 1, 1, 0.0])[:, None]
    calibration.confirm(obs[asked.index], asked.action, told)
    assert calibration.asked == 40
    assert calibration.confirmed == (6, 3)


@pytest.mark.parametrize(("confirmed", "named"), [(None, True), ((5, 3), True), ((6, 4), False), ((0, 0), False)])
def test_a_change_is_refused_without_more_than_three_answers_for_it_to_two_against_it(turned, confirmed, named):
    calibration = turned[0].copy(np.random.default_rng(0))
    calibration.confirmed = confirmed
    found = calibration.result()
    assert (found.verdict, found.refused) == ((CHANGED, ()) if named else (UNEXPLAINED, ("direction: change",)))
    assert (found.policy is turned[0].base) is not named
    assert named or "did not confirm" in found.words()[0]


def test_answers_that_nobody_asked_to_confirm_judge_changes_fitted_to_the_others(turned):
    calibration = turned[0].copy(np.random.default_rng(0))
    calibration.cross_confirm()
    agree, against = calibration.confirmed
    assert agree > 4 * against
    assert agree + against < calibration.asked  # others point to both policies, or to neither
    assert calibration.result().changes == ("direction: change",)
    told = calibration.answers
    signs = np.random.default_rng(1).choice([-1.0, 1.0], told.answer.shape)
    control = Calibration(POLICY, TURN, DIRECTIONS, EPS_DEG)
    control.learn(told.obs, told.action, told.answer * signs)
    control.cross_confirm()
    assert confirmation.refuses(control.confirmed)


def test_too_few_answers_and_spaces_without_cues_are_refused():
    with pytest.raises(UserError, match="give at least 5"):
        Calibration(POLICY, FAMILY, DIRECTIONS, EPS_DEG).result()
    with pytest.raises(UserError, match="without cues"):
        Calibration(POLICY, FAMILY, Choices(3), EPS_DEG)
