"""A policy corrected by labels alone: better on other situations, saved and loaded, judged by answers it never saw."""

import dataclasses
import json

import numpy as np
import pytest
import recorded_situations

import cuelearner_jax as cl
from cuelearner_jax.api.labels import rows_of
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.spaces import Box, cues_from
from cuelearner_jax.storage import label_files

LOW, HIGH = (-0.1, -0.1, -1.0), (0.1, 0.1, 1.0)
SPACE = Box(LOW, HIGH)
CUES = "left,right;up,down;open,close"
OFFSET = np.array([0.02, -0.015, 0.2], np.float32)  # a tenth of the ranges or so
EPS = 0.04
SIZES = GuideSizes(frame="action", feedback_layers=(32, 32), fit_steps=200, fit_batch_size=32)
NETWORK = {"guidance": "relative", "sizes": SIZES}
FAST = dataclasses.replace(Scalars(), eps_deg=EPS, tau_deg=0.002, tau_max_deg=1.0, feedback_learning_rate=0.01)


def wanted(obs):
    """What people have in mind."""
    return np.stack([0.06 * obs[:, 0], 0.06 * obs[:, 1], 0.6 * np.tanh(obs[:, 2] * obs[:, 0])], -1).astype(np.float32)


def off(obs):
    """A policy in NumPy that is wrong by a constant."""
    return wanted(obs) + OFFSET


def answers(obs, actions):
    """What people say of actions."""
    return recorded_situations.said(SPACE, actions, wanted(obs), EPS)


def asked(count, seed=0, reach=0.2):
    """Labels about the policy's actions, moved at random by up to `reach` of the ranges."""
    random = np.random.default_rng(seed)
    obs = random.uniform(-1, 1, (count, 3)).astype(np.float32)
    moved = off(obs) + reach * random.uniform(-1, 1, (count, 3)) * (np.array(HIGH) - np.array(LOW))
    actions = np.clip(moved, LOW, HIGH).astype(np.float32)
    return cl.Labels(obs, actions, answers(obs, actions))


OTHERS = np.random.default_rng(9).uniform(-1, 1, (200, 3)).astype(np.float32)
ERROR = np.abs(OFFSET / (np.array(HIGH) - np.array(LOW))).mean()


def error(policy, obs=OTHERS):
    """Mean distance from what people have in mind, in shares of the ranges."""
    return (np.abs(policy(obs) - np.clip(wanted(obs), LOW, HIGH)) / (np.array(HIGH) - np.array(LOW))).mean()


@pytest.fixture(scope="module")
def better():
    """Corrected by 150 labels."""
    how = {"cues": CUES, "low": np.array(LOW), "high": list(HIGH), "eps": EPS, "bound": 0.2}
    return cl.correct(off, asked(150), scalars=FAST, **NETWORK, **how)


def test_a_corrected_policy_is_nearer_to_what_people_have_in_mind(better):
    assert better.used
    assert [line[:14] for line in repr(better).splitlines()] == ["AdaptedPolicy("]
    assert error(off) == pytest.approx(ERROR, rel=0.02)
    assert error(better) < 0.5 * ERROR
    assert better.actions.cues[1].words == ("up", "down")
    assert better(OTHERS[0]).shape == (3,)


def test_it_agrees_with_more_answers_that_it_never_saw(better):
    found = cl.agreement(better, asked(100, seed=5))
    assert found.labels == 100
    assert found.policy[0] > found.base[0]
    assert found.policy[1] <= found.policy[0] <= found.policy[2]
    assert found.difference[0] == pytest.approx(found.policy[0] - found.base[0])
    assert found.right[0] == pytest.approx((asked(100, seed=5).answer == 0).mean(), abs=1e-6)
    assert any("always already right" in line for line in found.words())
    reads = better.outcome.request
    other = better.outcome._replace(request=dataclasses.replace(reads, scalars=Scalars(eps_deg=2 * EPS)))
    twice = dataclasses.replace(better, outcome=other)  # as of a reading, what corrects knows no strength of answers
    assert cl.agreement(twice, asked(100, seed=5)) == cl.agreement(better, asked(100, seed=5), eps=2 * EPS)


def test_agreement_counts_what_was_said_alone():
    obs = OTHERS[:4]
    actions = np.clip(off(obs), LOW, HIGH)
    said = answers(obs, actions)
    said[:, 1:] = cl.UNSAID
    of = cl.Labels(obs, actions, said)
    all_four = cl.agreement(wanted, of, eps=EPS, space=SPACE).policy
    np.testing.assert_allclose(all_four, [1.0, 4 / (4 + 1.96**2), 1.0], atol=1e-4)  # by Wilson's score
    assert cl.agreement(off, of, eps=EPS, space=SPACE).policy[0] == 0.0  # it calls each of its own actions right
    swapped = of._replace(answer=np.where(said == cl.UNSAID, said, -said))
    assert cl.agreement(wanted, swapped, eps=EPS, space=SPACE).policy[0] == 0.0


def test_labels_that_say_nothing_do_not_count():
    of = asked(40, seed=6)
    silent = of._replace(answer=np.full_like(of.answer, cl.UNSAID))
    both = cl.Labels(*map(np.concatenate, zip(of, silent, strict=True)))
    assert cl.agreement(off, both, eps=EPS, space=SPACE) == cl.agreement(off, of, eps=EPS, space=SPACE)
    np.testing.assert_array_equal(rows_of(both).answer, of.answer)
    with pytest.raises(cl.UserError, match="say nothing of any cue: give labels with answers"):
        cl.agreement(off, silent, eps=EPS, space=SPACE)


def test_it_is_saved_and_loaded_with_the_code_of_its_base(better, tmp_path):
    better.save(tmp_path / "better")
    again = cl.load_policy(tmp_path / "better", base=off)
    np.testing.assert_allclose(again(OTHERS), better(OTHERS), atol=1e-6)
    assert again.actions == better.actions
    with pytest.raises(cl.UserError, match="made of code"):
        cl.load_policy(tmp_path / "better")
    assert cl.agreement(again, asked(100, seed=5)).policy == cl.agreement(better, asked(100, seed=5)).policy


def test_it_can_be_corrected_again(better, tmp_path):
    how = {"eps": EPS, "bound": 0.1, "scalars": FAST, **NETWORK}
    again = cl.correct(better, asked(60, seed=3), **how)
    again.save(tmp_path / "again")
    assert better.trained.scalars.eps_deg == pytest.approx(1 / 36)  # what a second correction begins with
    assert json.loads((tmp_path / "again" / "policy.json").read_text())["of"] == {"code": f"{off.__module__}:off"}
    np.testing.assert_allclose(cl.load_policy(tmp_path / "again", base=off)(OTHERS), again(OTHERS), atol=1e-6)
    with pytest.raises(cl.UserError, match="corrected with other bounds or cues before"):
        cl.correct(better, asked(60), low=LOW, high=(1.0, 1.0, 1.0), **how)


def test_labels_of_a_file_say_their_own_space_and_strength(better, tmp_path):
    file = label_files.LabelFile({"name": "arm"}, "relative", better.actions, EPS, np.zeros(150), rows_of(asked(150)))
    label_files.write_file(tmp_path / "labels.parquet", file, "more")
    found = cl.correct(off, tmp_path, bound=0.2, scalars=FAST, **NETWORK)
    assert found.actions == Box(LOW, HIGH, cues_from(CUES))
    np.testing.assert_array_equal(found(OTHERS), better(OTHERS))
    with pytest.raises(cl.UserError, match="says its own space of actions: leave out low"):
        cl.correct(off, tmp_path, low=LOW, high=HIGH)
    with pytest.raises(cl.UserError, match="leave out eps"):
        cl.correct(off, tmp_path, eps=0.2)
    assert cl.agreement(off, tmp_path).labels == 150


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"labels": "absent", "low": None, "high": None, "cues": ""}, "no label file at absent"),
        ({"labels": cl.Labels(OTHERS[:20], wanted(OTHERS[:20]), np.zeros((20, 2)))}, r"give \(labels, 3\)"),
        ({"labels": (OTHERS, wanted(OTHERS))}, "labels are 2 arrays"),
        ({"labels": cl.Labels(OTHERS, OTHERS[:, 0], OTHERS[:, 0])}, "labels have shapes"),
        ({"low": (0.0,) * 3}, "actions are no vectors between the bounds"),
        ({"low": None}, "high is given alone"),
        ({"cues": "left,right"}, "give one cue an entry"),
        ({"policy": lambda obs: obs[:, :2]}, "returned actions of shape"),
        ({"space": SPACE}, "cues is given beside space"),
    ],
)
def test_what_would_lead_to_wrong_numbers_is_told_in_one_line(changed, told):
    usual = {"policy": off, "labels": asked(20), "cues": CUES, "low": LOW, "high": HIGH, "eps": EPS, "bound": 0.2}
    with pytest.raises(cl.UserError, match=told) as error:
        cl.correct(**{**usual, **NETWORK, **changed})
    assert "\n" not in str(error.value)
