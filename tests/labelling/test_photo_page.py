"""The page on a folder of pictures: arrows of cues, one cue a press, what is refused, and a script that answers."""

import re

import jax
import numpy as np
import pytest
import recorded_situations as recorded
from page_answers import labelled

pytest.importorskip("nicegui")

from cuelearner_jax.cli import label
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.labelling import controls, view
from cuelearner_jax.labelling.questions import Item
from cuelearner_jax.reading import Reading
from cuelearner_jax.spaces import UNSAID, Box, cues_from
from cuelearner_jax.storage import label_files
from cuelearner_jax.types import Sketch

pytestmark = pytest.mark.usefixtures("garbage_of_its_own")

CUES = "left,right;up,down;open,close"
SMALL = ("--sizes.feedback-layers", "8", "--sizes.fit-steps", "20")
BOUNDS = ("--task.low", "-0.5", "0", "-1", "--task.high", "0.5", "0.4", "1")
GOAL = np.array([0.25, 0.3, 0.0])
PHOTO = Sketch((0, 0, 640, 480), "<image class='photo'/>", {}, {}, (320, 240), (0, 120), 0.0)


@pytest.fixture
def folder(tmp_path):
    """A folder of twelve pictures."""
    recorded.write(tmp_path / "situations")
    return tmp_path / "situations"


def arrows(svg):
    """Name -> angle on the screen [deg, counterclockwise], key and title of each cue's arrow in a picture."""
    found = {}
    for part in svg.split('<g class="said ')[1:]:
        name, drawn = re.match(r'\w+" data-name="([^"]+)">', part)[1], part
        x1, y1, x2, y2 = map(float, re.search(r'x1="(\S+)" y1="(\S+)" x2="(\S+)" y2="(\S+)"', drawn).groups())
        words = re.findall(r">([^<>]+)</(?:text|title)>", drawn)[::-1]
        found[name] = round(np.degrees(np.arctan2(y1 - y2, x2 - x1))), *words
    return found


def drawn(space, action=None, sketch=PHOTO, one_cue=False, refined=None):
    """The picture of an item."""
    action = np.asarray(space.middle()) if action is None else action
    return view.picture(Item(0, None, action, sketch, refined), RELATIVE, 0.1, space, one_cue)


def box(words):
    """A box around zero with these cues."""
    cues = cues_from(words)
    return Box((-1.0,) * len(cues), (1.0,) * len(cues), cues)


def test_cues_are_arrows_where_their_words_point_with_keys_and_words():
    found = arrows(drawn(box(f"forward,back;{CUES}")))
    assert found == {
        "pick-0-more": (45, "F", "forward"),
        "pick-0-less": (-135, "B", "back"),
        "pick-1-more": (180, "←", "left"),
        "pick-1-less": (0, "→", "right"),
        "pick-2-more": (90, "↑", "up"),
        "pick-2-less": (-90, "↓", "down"),
    }  # to open points nowhere: its words stand beside the picture, as all words do
    assert {name[:5] for name in arrows(drawn(box(CUES), one_cue=True))} == {"only-"}
    assert arrows(drawn(box("higher,lower"))) == {"+1": (90, "H", "higher"), "-1": (-90, "L", "lower")}
    assert arrows(drawn(box("right,left")))["+1"][0] == 0  # more may be to the right
    right = drawn(Box((-0.2, -0.5), (0.6, 0.1), cues_from("right,left;up,down")), np.float32([0.16, -0.01]))
    assert arrows(right.replace('"arrow asked"', '"said arrow" data-name="0"'))["0"] == (-5,)  # from 0, not the middle
    assert view.by_words(cues_from("left,up")[0]) is None
    assert view.by_words(cues_from("more to the left,less")[0]) == (-1.0, 0.0)


def test_one_press_about_one_cue_says_nothing_of_the_others():
    known = controls.controls(RELATIVE, box(CUES), one_cue=True)
    said = {name: controls.answer_of(box(CUES), one, None, {}) for name, one in known.items() if one.answer}
    assert said.keys() == {f"only-{cue}-{way}" for cue in range(3) for way in ("more", "less")} | {"rest"}
    np.testing.assert_array_equal(said["only-1-less"], [UNSAID, -1.0, UNSAID])
    np.testing.assert_array_equal(said["rest"], [0.0, 0.0, 0.0])


def test_entries_that_no_cue_names_are_not_asked_about():
    space = Box((-1.0,) * 3, (1.0,) * 3, cues_from("grip=open,close", ("pan", "lift", "grip")))
    known = controls.controls(RELATIVE, space)
    assert {one.cue for one in known.values()} == {None, 2}
    more = known["pick-2-more"].answer[0]
    np.testing.assert_array_equal(controls.answer_of(space, known["rest"], None, {2: more}), [UNSAID, UNSAID, 1.0])
    np.testing.assert_array_equal(controls.answer_of(space, known["rest"], None, {}), [UNSAID, UNSAID, 0.0])
    reading = Reading(lambda obs: obs, (), space, 0.1, 20)
    asked = reading.questions(np.zeros((8, 3), np.float32), 8, jax.random.key(0))[1]
    assert (asked[:, :2] == 0).all()
    assert (asked[:, 2] != 0).all()
    with pytest.raises(UserError, match="cues name jaw, but the entries of an action are pan, lift, grip"):
        cues_from("jaw=open,close", ("pan", "lift", "grip"))


def test_a_script_labels_a_folder_by_the_command_and_labels_of_others_are_refused(folder, tmp_path, capsys):
    told = []

    def ask(obs, action):
        """What a person says who wants the gripper at one place, and sees a tenth of a range."""
        apart = (GOAL - action) / (np.array(recorded.HIGH) - recorded.LOW)
        told.append(np.where(np.abs(apart) > 0.1, np.sign(apart), 0.0))
        return told[-1]

    command = [folder, "--cues", CUES, *BOUNDS, *SMALL, "--out", tmp_path / "mine", "--who", "Ada"]
    found = labelled([*command, "--labels", "12"], ask)
    assert 'next: cl.correct(policy, "' in capsys.readouterr().out
    file = label_files.read(found)
    np.testing.assert_array_equal(file.labels.answer, told)
    assert file.people.who.tolist() == ["Ada"] * 12
    assert sorted(map(tuple, np.asarray(file.labels.obs))) == sorted(map(tuple, recorded.arrays()[0]))  # each once
    cues = [folder, "--cues", "right,left;up,down;open,close", *command[3:]]
    with pytest.raises(UserError, match=r"another task\.cues"):
        label.run([*map(str, cues)])
