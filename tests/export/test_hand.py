"""A hand's kinematics of an MJCF: MuJoCo's positions, a constant error that labels correct, arrows, refusals."""

import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from recorded_situations import plugin_module

from cuelearner_jax.tasks import logs

MJCF = Path(__file__).with_name("arm.xml")
JOINTS = ["pan", "lift", "elbow", "turn", "flex", "roll"]
ENTRIES = [*(f"{name}.pos" for name in JOINTS), "gripper"]
LOW, HIGH = np.array([[-40, 0, 50, -40, 30, -60, 0], [40, 40, 90, 40, 90, 60, 100]])  # degrees, percent of the gripper
OFF = np.array([0.0, 0.03, -0.02])  # where the hand should be, from where it is led [m]
WIDTH, HEIGHT = 400, 200
FROM_FRONT = [[0, 250, 0, 100], [0, 0, -250, 150], [0, 0, 0, 1]]  # a camera that faces the arm: left is to the right
BOTH = ([0.5 / 200, 0, 0], [0, 1 / HEIGHT, 0], [0, 0, 1])  # its picture is the left half of two


@pytest.fixture(scope="module")
def kinematics():
    return plugin_module("kinematics")


@pytest.fixture(scope="module")
def hand(kinematics):
    return kinematics.hand_of(MJCF, "grip", [], "degrees", [*ENTRIES[:-1], "gripper"])


@pytest.fixture(scope="module")
def proposed():
    return np.random.default_rng(0).uniform(LOW, HIGH, (80, 7)).astype(np.float32)


@pytest.fixture(scope="module")
def folder(hand, proposed, tmp_path_factory):
    """Situations as `lerobot_processor_cuelearner situations --mjcf` writes them."""
    folder, places = tmp_path_factory.mktemp("situations"), hand.place(proposed).astype(np.float32)
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "0.png")
    columns = {f"observation.{name}": proposed[:, number] for number, name in enumerate(ENTRIES)}
    columns |= {f"action.{name}": places[:, number] for number, name in enumerate("xyz")}
    columns |= {"phase": np.zeros(80, np.float32), "picture": ["0.png"] * 80, "hand": list(places - [0, 0.1, 0])}
    about = {"low": (places.min(0) - 0.1).tolist(), "high": (places.max(0) + 0.1).tolist()}
    about["hand"] = {"entries": ENTRIES, **{name: array.tolist() for name, array in hand.arrays.items()}}
    about |= {"projections": [(np.array(BOTH) @ FROM_FRONT).tolist()], "areas": [[0, 0, 0.5, 1]]}
    table = pa.table(columns).replace_schema_metadata({"cuelearner": json.dumps(about)})
    pq.write_table(table, folder / "situations.parquet")
    return folder


@pytest.fixture(scope="module")
def task(folder):
    return logs.task_of(folder, "forward,back;left,right;up,down")


def test_positions_are_those_of_mujoco(hand, proposed):
    poses = np.array([[0] * 7, [0, 90, 0, 0, 0, 0, 50]])  # upright, and forward
    np.testing.assert_allclose(hand.place(poses), [[0.01, 0, 0.84], [0.65, 0, 0.18]], atol=1e-9)
    model = mujoco.MjModel.from_xml_path(str(MJCF))
    data = mujoco.MjData(model)
    data.qpos[:6] = np.deg2rad(proposed[0, :6])
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(hand.place(proposed[:1])[0], data.site("grip").xpos, atol=1e-6)


def test_joints_move_the_hand_within_their_limits(hand, proposed):
    moved = hand.move(proposed, lambda place: np.broadcast_to(OFF, place.shape))
    np.testing.assert_allclose(hand.place(moved) - hand.place(proposed), np.tile(OFF, (80, 1)), atol=1e-4)
    np.testing.assert_array_equal(moved[:, 6], proposed[:, 6])  # the gripper
    np.testing.assert_array_equal(hand.move(proposed, np.zeros_like), proposed)
    far = hand.move(proposed, lambda place: np.tile([1.0, 0, 0], (80, 1))) @ hand.joints  # beyond the arm's reach
    assert (far >= hand.low - 1e-9).all()
    assert (far <= hand.high + 1e-9).all()


def test_kinematics_of_a_checkpoint_move_the_hand_and_are_held_against_golden_cases(kinematics, proposed, task):
    stored = json.loads(task.plain().hand)
    assert stored.pop("entries") == ENTRIES
    arrays = {name: np.asarray(array, np.float32) for name, array in stored.items()}  # as a checkpoint has them
    again = kinematics.Hand(arrays)
    moved = again.move(proposed, lambda place: np.broadcast_to(OFF, place.shape))
    assert np.linalg.norm(again.place(moved) - again.place(proposed) - OFF, axis=1).max() < 1e-4
    with pytest.raises(ValueError, match=r"off by .* m in golden cases"):
        kinematics.Hand(arrays | {"site": arrays["site"] + 0.01})


def test_actions_are_arrows_over_the_pictures_of_cameras_that_see_the_hand(task):
    env = task.environment(task.plain())
    state = logs.SituationState(3, 0)
    hand = np.asarray(env.recorded[3]) - [0, 0.1, 0]
    (drawn,) = logs.PICTURES.trails(env, state, env.recorded[3][None])
    x, y, tip_x, tip_y = map(float, re.search(r'x1="(\S+)" y1="(\S+)".*points="([\d.-]+),([\d.-]+)', drawn).groups())
    # 2.5 pixels a centimetre; the hand's left is to the right, and 10 cm are 25 pixels
    np.testing.assert_allclose([x, y], [100 + 250 * hand[1], 150 - 250 * hand[2]], atol=0.01)
    np.testing.assert_allclose([tip_x - x, tip_y - y], [25, 0], atol=0.01)
    forward, left, up = logs.PICTURES.sketch(env, state).points
    assert forward is None  # it leads into the picture
    np.testing.assert_allclose([left, up], [(1, 0), (0, -1)], atol=1e-6)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (("arm.xml", "palm", [], ENTRIES), "has no site palm: give --site one of grip"),
        (("arm.xml", "grip", [], ENTRIES[1:]), "the action's entries are lift.pos, elbow.pos, .*: give --joints"),
        (("arm.xml", "grip", ["pan", "jaw"], ENTRIES), "jaw of --joints does not move grip: its joints are pan, lift"),
        (("none.xml", "grip", [], ENTRIES), "none.xml cannot be read"),
    ],
)
def test_a_robot_that_does_not_fit_is_refused_in_one_line(asked, said, kinematics):
    file, site, joints, entries = asked
    with pytest.raises(SystemExit, match=said) as refusal:
        kinematics.hand_of(MJCF.with_name(file), site, joints, "degrees", entries)
    assert "\n" not in str(refusal.value)
