"""Questions about pairs: the page shows two actions, and both stay with the answer in files and what reads them."""

import json

import numpy as np
import probes
import pytest
from box_task import GRIPPER, TASK
from sessions import ENV, OWN, taught

pytest.importorskip("nicegui")
from page_user import press, shown, tip, told_browser

from cuelearner_jax.cli import main
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import PREFERENCE
from cuelearner_jax.guides import registry
from cuelearner_jax.labelling import comparing, view
from cuelearner_jax.labelling.questions import Item
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import label_files

pytestmark = pytest.mark.usefixtures("garbage_of_its_own")


def nearer(item):
    """The choice of a teacher of the best direction between A and B: -1, 0 or 1."""
    best = np.asarray(ENV.best(item.guide.obs))
    away = [float(np.degrees(DIRECTIONS.distance(best, item.pair[side]))) for side in ("left", "right")]
    gain = away[0] - away[1]
    return np.array([0.0 if abs(gain) <= probes.SCALARS.eps_deg / 2 else np.sign(gain)], np.float32)


def test_the_page_shows_both_actions_and_the_file_has_the_choice_and_the_second(opened, tmp_path):
    session, chosen = opened(kind="preference"), []
    names = {-1.0: "first", 0.0: "same", 1.0: "second"}

    async def acts(user, pages):
        (page,) = pages
        for words in ("Which is better, A or B?", "A is better", "no difference", "film of B"):
            await user.should_see(words)
        for number in range(4):
            item = session.item
            for side, action in item.pair.items():
                direction = tip(page._scene.content, side) / {"left": 1.8, "right": 1.25}[side]  # A beyond B
                np.testing.assert_allclose(direction, [action[0], -action[1]], atol=1e-3)
            assert 'class="arrow asked"' not in page._scene.content
            chosen.append((item, nearer(item)))
            await press(user, names[float(chosen[-1][1][0])], lambda n=number: page._parts_of == n + 1)
        with told_browser(user) as films:
            for side in ("left", "right"):
                await page._act(f"film-{side}", 4, {"item": 4})
        words = [json.loads(code.removeprefix("cue.play(").removesuffix(")"))["words"] for code in films]
        assert words == [session.questions.film(session.item, action).words for action in session.item.pair.values()]
        await press(user, "unsure", lambda: session.number == 5)
        await press(user, "undo", lambda: session.number == 4)

    shown(session, acts)
    file = label_files.read(tmp_path / "labels")
    assert (file.answers, file.eps, file.labels.answer.shape) == ("preference", None, (4, 3))
    for (item, choice), action, answer in zip(chosen, file.labels.action, file.labels.answer, strict=True):
        first, second = (item.pair[side] for side in (("right", "left") if item.number % 2 else ("left", "right")))
        np.testing.assert_array_equal(action, first)
        np.testing.assert_array_equal(answer, [*(-choice if item.number % 2 else choice), *second])
    before, _ = session.item, session.close()
    again = opened(kind="preference")
    np.testing.assert_array_equal(again.item.second, before.second)  # the question that was taken back


def test_pairs_of_a_page_are_those_of_a_simulated_teacher_and_train_an_agent(opened, tmp_path, capsys):
    session = opened(kind="preference")
    for number in range(10):
        assert session.answer(number, nearer(session.item))
    *_, after = taught("preference")
    file = label_files.read(session.finish())
    for name in ("obs", "action", "answer"):
        np.testing.assert_allclose(getattr(file.labels, name), getattr(after.labels, name)[:10], atol=1e-6)
    labels = str(tmp_path / "labels")
    assert str(comparing.between(file, file)) == "100% of 10"
    other = file._replace(labels=file.labels.replace(answer=file.labels.answer * np.float32([1, -1, -1])))
    assert comparing.between(file, other).count == 0  # of the same first actions, but other pairs
    train = ["train", OWN, "--preset", "paper", "--labels", "10", "--labels-from", labels, "--guidance"]
    assert main([*train, "preference", "--out", str(tmp_path / "run")]) == 0
    np.testing.assert_array_equal(label_files.read(tmp_path / "run" / "preference").labels.answer, file.labels.answer)
    assert main([*train, "relative", "--out", str(tmp_path / "no")]) == 2
    assert "holds preference answers, but guidance relative needs relative answers" in capsys.readouterr().err
    assert main(["labels", "inspect", labels, "--teacher"]) == 0
    printed = capsys.readouterr().out
    counts = [int((file.labels.answer[:, 0] == choice).sum()) for choice in (-1, 0, 1)]
    for words in ("100% of 10", f"-1: {counts[0]}, 0: {counts[1]}, 1: {counts[2]}"):
        assert words in printed, printed
    spaces = registry.spaces_of(ENV)
    for answer, words in (([2.0, 1.0, 0.0], "none of -1, 0, 1"), ([1.0, 2.0, 0.0], "answers are no unit vectors")):
        wrong = file.labels.replace(answer=np.tile(np.float32(answer), (10, 1)))
        with pytest.raises(UserError, match=words):
            external_labels.check(wrong, spaces, PREFERENCE)


def test_actions_of_a_box_are_written_out_and_drawn_by_what_they_lead_to():
    env = TASK.environment(TASK.presets["paper"].config.task)
    sketch, actions = TASK.pictures().sketch(env, np.zeros(2)), np.asarray(GRIPPER.spread(2))
    item = Item(0, None, actions[0], sketch, trails={"left": "<a/>", "right": "<b/>"}, second=actions[1])
    svg = view.picture(item, PREFERENCE, 0.1, GRIPPER)
    assert 'class="said' not in svg  # no cue is asked about
    assert '<g class="trail left"><a/></g>' in svg
    a, b = map(GRIPPER.words_of, actions)
    assert view.note(item, PREFERENCE, 0.1, GRIPPER) == f"A: {a}. B: {b}"
