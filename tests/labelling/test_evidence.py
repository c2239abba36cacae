"""A session of a reading: its questions narrow the estimate, which the page shows, and a restart goes on."""

import dataclasses
import re

import numpy as np
import probes
import pytest
from sessions import ENV, expert, give, settled

from cuelearner_jax.labelling.plan import Base
from cuelearner_jax.policies import Opaque

STRAIGHT = Base(Opaque(lambda obs: obs, on_host=True), "straight")  # the expert means 0.6 rad, 34.4 degrees, beside
EPS_DEG = 5.0
CONFIG = dataclasses.replace(probes.CONFIG, scalars=dataclasses.replace(probes.SCALARS, eps_deg=EPS_DEG))
SETTINGS = {"kind": "reading", "base": STRAIGHT, "config": CONFIG, "labels": 30}
LINE = re.compile(r"action: turn: (\S+) \[(\S+), (\S+)\] degrees")


def estimate(status):
    """Mean, lower and upper end of what the page tells."""
    found = LINE.match(status.newest.lines[0])
    assert found, status.newest.lines
    return [float(number) for number in found.groups()]


def test_the_estimate_narrows_the_page_shows_it_and_the_policy_follows(opened):
    pytest.importorskip("nicegui")
    from page_user import shown

    async def acts(user, pages):
        await user.should_see("estimate 2, of 20 labels")
        await user.should_see("action: turn: ")
        await user.should_see("the corrected policy")

    session = opened(**SETTINGS)
    assert session.status().newest.lines == ()
    ends = []
    for number in (1, 2):
        give(session, 10, EPS_DEG)
        mean, low, high = estimate(settled(session, fits=number))
        assert low < 34.4 < high
        ends.append(high - low)
    assert ends[1] < ends[0]
    assert abs(mean - 34.4) < 12
    item = session.item
    assert float(item.refined @ np.asarray(ENV.best(item.guide.obs))) > np.cos(np.deg2rad(12))
    shown(session, acts)


def test_an_answer_taken_back_is_forgotten_and_a_policy_that_is_right_is_told_to_be(opened):
    right = Base(Opaque(lambda obs: np.asarray(ENV.best(obs)), on_host=True), "right")
    session = opened(**{**SETTINGS, "base": right})
    give(session, 9, EPS_DEG)
    wrong = expert(session.item, EPS_DEG) + (1.0 if expert(session.item, EPS_DEG)[0] <= 0 else -1.0)
    assert session.answer(session.number, wrong)
    settled(session, fits=1)
    assert session.undo(session.number)
    give(session, 11, EPS_DEG)
    status = settled(session, fits=2)
    assert status.newest.labels == 20
    np.testing.assert_array_equal(session.questions.learner._rows[2], [row[2] for row in session.record.labels()])
    assert status.newest.lines == ("The answers ask for no change.",)
    item = session.item
    session.close()
    again = opened(**{**SETTINGS, "base": right})  # a restart goes on
    np.testing.assert_allclose(again.item.guide.obs, item.guide.obs, atol=1e-6)
    assert (again.number, again.status().newest.labels, again.status().newest.lines) == (20, 20, status.newest.lines)
