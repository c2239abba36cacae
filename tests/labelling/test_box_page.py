"""The page of a task whose actions are a box: each cue by its own words and keys, "already right" or not said."""

import asyncio

import numpy as np
import pytest
from box_task import EPS, GRIPPER, SCALARS, TASK

from cuelearner_jax.cli import label
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import DEMONSTRATION, RELATIVE, SCALAR
from cuelearner_jax.labelling import controls
from cuelearner_jax.labelling.learner import agreement
from cuelearner_jax.spaces import UNSAID, Box, Choices, Cue
from cuelearner_jax.storage import label_files


def planned(**options):
    """What `cuelearner label` plans for the task."""
    config = TASK.presets["paper"].config
    options = {"labels": 20, "guidance": "relative", **options}
    asked = label.LabelOptions(
        task=config.task, sizes=config.sizes, scalars=SCALARS, out=label.Path("labels"), **options
    )
    return label.make_plan(TASK, config, asked)


def test_each_cue_has_its_words_and_keys_and_no_key_says_two_things():
    known = controls.controls(RELATIVE, GRIPPER)
    keys = [key for control in known.values() for key in control.keys]
    assert len(keys) == len(set(keys))
    words = [control.words for control in known.values() if control.cue == 2]
    assert words == ["open", "already right", "close", "not said"]
    assert known["pick-2-more"].keys == ("o", "O")
    assert known["pick-1-less"].keys == ("f", "F")
    assert known["film"].keys == ("v", "V")  # F is the second cue's
    assert "height: down: F" in controls.help_lines(RELATIVE, GRIPPER, known.values())
    assert "ArrowDown" in known["unsure"].keys
    assert "film" not in controls.controls(RELATIVE, GRIPPER, films=False)
    assert "film-refined" not in controls.controls(RELATIVE, GRIPPER, simulated=False)


def test_the_page_asks_about_each_cue_and_the_file_keeps_what_was_said(tmp_path):
    pytest.importorskip("nicegui")
    from page_user import press, shown

    from cuelearner_jax.labelling.session import Session

    with Session(planned(), tmp_path) as session:

        async def acts(user, pages):
            (page,) = pages
            for words in ("sideways", "height", "fingers", "open", "not said", "Which way should the action change?"):
                await user.should_see(words)
            await user.should_see("the action: sideways")
            assert page._scene.content.count('class="said') == 4  # left, right, up, down; to open points nowhere
            assert "<path d='0'/>" in page._scene.content
            user.find(marker="pick-0-less").click()
            user.find(marker="pick-2-more").click()
            await asyncio.sleep(0.1)
            chosen = [control.name for control, button in page._picks.items() if "picked" in button.classes]
            assert chosen == ["pick-0-less", "pick-1-unsaid", "pick-2-more"]
            await press(user, "rest", lambda: page._parts_of == 1)
            assert page._parts == {}  # of the next question nothing is said yet
            user.find(marker="pick-1-more").click()
            await asyncio.sleep(0.1)
            await press(user, "send", lambda: session.number == 2)
            await press(user, "send", lambda: session.number == 3)
            await user.should_see("1 not known")

        shown(session, acts)
    file = label_files.read(tmp_path)
    np.testing.assert_array_equal(file.labels.answer, [[-1.0, 0.0, 1.0], [UNSAID, 1.0, UNSAID]])
    assert (file.space, file.eps) == (GRIPPER, pytest.approx(EPS))
    assert [cue.words for cue in file.space.cues] == [("left", "right"), ("up", "down"), ("open", "close")]


def test_of_one_cue_the_page_has_its_words_and_shows_what_answers_would_make_of_the_action():
    order = Choices(5, Cue("gear", ("higher", "lower"), ("PageUp", "PageDown"), "steps"))
    more, right, less = controls.answers(RELATIVE, order)
    assert [one.words for one in (more, right, less)] == ["higher", "already right", "lower"]
    assert (more.keys, less.keys) == (("PageUp",), ("PageDown",))
    found = controls.outcomes(RELATIVE, order, np.eye(5, dtype=np.float32)[2], 1.0)
    assert {name: int(np.argmax(action)) for name, action in found.items()} == {"asked": 2, "left": 3, "right": 1}
    assert controls.question(SCALAR, order) == "Is the action good?"


def test_what_a_page_cannot_ask_is_refused():
    with pytest.raises(UserError, match="the page supports demonstration answers only for directions"):
        planned(guidance="demonstration")
    with pytest.raises(UserError, match="no cues to ask about"):
        controls.check(RELATIVE, Choices(3))
    controls.check(SCALAR, Choices(3))
    twice = Box((0.0, 0.0), (1.0, 1.0), (Cue("a", ("more", "less"), ("q", "x"), "shares"),) * 2)
    with pytest.raises(UserError, match="the key 'Q' stands for two answers"):
        controls.check(RELATIVE, twice)


def test_agreement_counts_the_cues_of_which_both_say_something():
    space = TASK.environment(TASK.presets["paper"].config.task).actions
    one = np.array([[1, 0, UNSAID], [1, 0, 0], [0, 0, 0], [1, UNSAID, UNSAID]], np.float32)
    other = np.array([[1, UNSAID, -1], [1, 0, -1], [0, 0, 0], [UNSAID, 1, UNSAID]], np.float32)  # the last share no cue
    assert str(agreement(RELATIVE, space, one, other)) == "67% of 3"
    apart = agreement(DEMONSTRATION, space, np.zeros((1, 3), np.float32), np.array([[0.0, 1.0, 0.0]], np.float32))
    assert str(apart) == "0.25 shares apart over 1"
