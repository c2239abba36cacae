"""The page without a browser: what it shows and what its buttons do, for each form of feedback."""

import html
import json
import math
import re
import threading

import httpx
import numpy as np
import pytest
from sessions import expert

pytest.importorskip("nicegui")
from fastapi import FastAPI
from page_user import press, shown, tip, told_browser

from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import DEMONSTRATION, RELATIVE, SCALAR, AnswerForm
from cuelearner_jax.labelling import controls, server, view
from cuelearner_jax.labelling.server import Commands
from cuelearner_jax.spaces import DIRECTIONS, directions
from cuelearner_jax.storage import label_files

pytestmark = pytest.mark.usefixtures("garbage_of_its_own")


def test_buttons_answer_what_is_on_the_page_and_it_tells_how_far_it_is(opened, tmp_path):
    session = opened()
    words = {1.0: "+1", 0.0: "0", -1.0: "-1"}
    told = []

    async def acts(user, pages):
        await user.should_see("0 of 20")
        await user.should_see("Which way should the middle arrow turn?")
        for number in range(10):
            told.append(float(expert(session.item)[0]))
            await press(user, words[told[-1]], lambda number=number: session.number == number + 1)
        await user.should_see("10 of 20")
        await press(user, "unsure", lambda: session.number == 11)
        await user.should_see("1 not known")
        await press(user, "undo", lambda: session.number == 10)
        await user.should_see("model 1, of 10 labels", retries=600)
        await user.should_see("held-out labels")
        user.find(marker="help").click()
        await user.should_see("more to the left: ←, A")
        (page,) = pages
        page._help.open()
        with told_browser(user) as told_it:
            await page._act("+1", 10, {"name": "+1", "item": 10})  # the question lies under the help
        assert (session.number, told_it) == (10, ['cue.refused("a window lies over the question: close it first")'])

    shown(session, acts)
    file = label_files.read(tmp_path / "labels")
    assert file.labels.answer[:, 0].tolist() == told
    assert file.counts == {"answer": 10, "unsure": 1, "undone": 1}


def test_an_answer_names_its_item_and_when_all_is_answered_the_page_says_so(opened, monkeypatch):
    session = opened(labels=2)

    async def acts(user, pages):
        (page,) = pages
        told = {"name": "+1", "item": 0, "angle": None, "seconds": 0.0}
        with told_browser(user) as told_it:
            await page._act("+1", 0, told)
            await page._act("+1", 0, told)  # the key again, before the next question came
            await page._act("undo", 0, {"name": "undo", "item": 0})
        assert session.number == 1
        assert told_it == ['cue.refused("the next question was already shown")'] * 2  # each is told as not taken
        with told_browser(user) as told_it, monkeypatch.context() as patched:
            patched.setattr(session, "answer", lambda *_: 1 / 0)
            await page._act("+1", 1, told)
        assert told_it == ['cue.refused("division by zero")']
        await page._act("nonsense", 1, {"name": "nonsense", "item": 1})
        await page._act("point", 1, {"name": "point", "item": 1, "angle": 30.0})  # not of this form
        assert session.number == 1
        assert 'data-item="1"' in page._scene.content
        await press(user, "0", lambda: session.number == 2)
        await user.should_see("All labels are given")
        assert page._scene.content == ""
        assert not any(button.enabled for button in page._pressable)

    shown(session, acts)


def test_keys_are_told_apart_and_every_answer_is_one_of_the_form():
    five = AnswerForm("five", lambda _: 1, lambda _: "worth", lambda *told: None, lambda _: (0.0, 0.25, 0.5, 0.75, 1.0))
    for form in (RELATIVE, DEMONSTRATION, SCALAR, five):
        keys = [key for control in controls.controls(form, DIRECTIONS).values() for key in control.keys]
        assert len(keys) == len(set(keys)) >= 5
        answers = [control.answer for control in controls.answers(form, DIRECTIONS)]
        assert sorted(answers) == sorted((value,) for value in (form.values(DIRECTIONS) if form.values else ()))
    left, _, right = controls.answers(RELATIVE, DIRECTIONS)
    assert (left.answer, left.keys, right.keys) == ((1.0,), ("ArrowLeft", "a", "A"), ("ArrowRight", "d", "D"))
    assert controls.answer_of(DIRECTIONS, controls.UNSURE, None, {}) is None


def test_every_page_ends_where_it_says_what_was_saved(opened, tmp_path):
    session, stopping = opened(), threading.Event()
    site = server.Site(Commands("cuelearner label mine", lambda labels: f"cuelearner train <{labels}>"), stopping)
    site.session = session
    app = FastAPI()
    app.add_route(server.FINISHED, site.last_page)

    async def seen(kind, address):
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://page") as client:
            return await client.request(kind, address)

    async def acts(user, its_pages):
        site.pages.update(its_pages)
        (page,) = its_pages
        with pytest.raises(UserError, match="no answer to save yet"):
            await site.finish()
        for number in range(2):
            await press(user, "+1", lambda number=number: session.number == number + 1)
        assert (await seen("GET", server.FINISHED)).status_code == 404
        with told_browser(user) as told_it:
            await page._end()
        assert told_it == [f'location.replace("{server.FINISHED}")']
        assert not stopping.is_set()  # until a browser has shown it
        text = (await seen("GET", server.FINISHED)).text
        place = str(tmp_path / "labels" / label_files.PARQUET)
        for words in (f"2 of 20 labels are saved, in {place}", "cuelearner train &lt;2&gt;", "cuelearner label mine"):
            assert words in text
        assert stopping.is_set()

    shown(session, acts, site.finish)
    assert len(label_files.read(tmp_path / "labels").people.item) == 2


WAYS = ("left", "right")


def turned_by(action, by_deg):
    """A direction turned counterclockwise."""
    return np.asarray(directions.rotate(action, math.radians(by_deg)))


def test_arrows_point_where_actions_do(opened):
    session = opened()
    item = session.item._replace(action=np.float32([0.6, 0.8]), refined=np.float32([-1.0, 0.0]))
    svg = view.picture(item, RELATIVE, 20.0)
    angle = math.degrees(math.atan2(0.8, 0.6))
    for name, turned, length in (
        ("asked", 0, 1),
        ("left", 20, 1.25),
        ("right", -20, 1.25),
        ("refined", 180 - angle, 0.8),
    ):
        at = math.radians(angle + turned)
        np.testing.assert_allclose(tip(svg, name), [length * math.cos(at), -length * math.sin(at)], atol=1e-3)
    up = item._replace(sketch=item.sketch._replace(turn=90.0, foot=(1.0, 2.0)), action=np.float32([1.0, 0.0]))
    np.testing.assert_allclose(tip(view.picture(up, RELATIVE, 20.0), "asked"), [1.0, 1.0], atol=1e-3)
    edge = up._replace(sketch=up.sketch._replace(box=(0.0, 1.5, 2.0, 2.0)))  # half a metre ahead the picture ends
    x, y = tip(view.picture(edge, RELATIVE, 20.0), "asked")
    assert (x, 1.5 < y < 1.55) == (pytest.approx(1.0, abs=1e-3), True)
    assert json.loads(html.unescape(re.search('data-places="([^"]*)"', svg)[1])).keys() == {"dot"}
    down = view.picture(item._replace(action=np.float32([0.0, -1.0])), RELATIVE, 20.0)
    keys = {name: float(re.search(rf'class="arrow {name}">.*?<text x="([^"]*)"[^>]*>(.)', down)[1]) for name in WAYS}
    assert keys["left"] > 0.3  # of an arrow that points down the left key moves the tip to the right of the screen
    assert keys["right"] < -0.3
    assert [re.search(rf'class="arrow {name}">.*?<text [^>]*>(.)', down)[1] for name in WAYS] == ["←", "→"]
    assert "&lt;</text>" in view.arrow(item.sketch, 0.0, "left", key="<")
    made = session.questions
    made.pictures = made.pictures._replace(trails=lambda env, state, actions: [f"<{a[0]:.2f}>" for a in actions])
    trails = made.draw(item._replace(trails=None)).trails
    assert [*trails] == ["asked", *WAYS]
    assert trails["left"] == f"<{turned_by(item.action, 20.0)[0]:.2f}>"
    shown = view.picture(item._replace(trails=trails), RELATIVE, 20.0)
    assert all(f'<g class="trail {name}">{drawn}</g>' in shown for name, drawn in trails.items())
    assert 'class="aim"' not in shown
    assert "refined" not in view.picture(item._replace(refined=item.action), RELATIVE, 20.0)
    np.testing.assert_allclose(turned_by(item.action, 90.0), [-0.8, 0.6], atol=1e-6)


def test_a_film_shows_what_the_action_leads_to(opened):
    session = opened()
    item, made = session.item, session.questions
    best = np.asarray(made.env.best(item.guide.obs))
    assert made.film(item, best).words == "True"
    assert made.film(item, turned_by(best, 90.0)).words == "False"
    assert made.film(item, best).frames[-1] == {"dot": None}
