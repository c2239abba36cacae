"""Navigation pictures, looked at pixel by pixel, and the records behind them: what is drawn is what happened."""

import math

import imageio.v2 as imageio
import jax
import numpy as np
import pytest
from pictures import is_colour
from rooms import room

from cuelearner_envs.navigation import drawing, scan
from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.recording import record, situation
from cuelearner_envs.navigation.robot import Robot
from cuelearner_jax.policies import Heuristic

ENV = Navigation(worlds=jax.tree.map(lambda leaf: leaf[None], room([[-5.5, 2.0]], [[4.0, 2.0]])))


@pytest.fixture(scope="module")
def frames():
    """Frames of walking straight toward the goal, into a box."""
    return [frame for frame in record(ENV, Heuristic(ENV), jax.random.key(1), 40)[0] if frame.episode == 0]


def looker(image, dpi=160):
    """A function that looks up a picture with a strip of words below it at a place in the room [m]."""
    dots = image.shape[1] / (12.0 + 2 * drawing.MARGIN)  # in a metre
    middle = (image.shape[0] - drawing.STRIP_INCHES * dpi) / 2

    def pixel(x, y):
        return image[round(middle - y * dots), round(image.shape[1] / 2 + x * dots)]

    return pixel


def ahead(angle):
    return np.array([math.cos(angle), math.sin(angle)])


def test_a_frame_holds_what_was_seen_and_chosen_at_its_pose_and_where_the_episode_ended(frames):
    for frame in frames[3:9:3]:
        np.testing.assert_allclose(frame.ranges, scan(frame.world, frame.pose), rtol=1e-5)
        away = math.atan2(*(frame.goal - frame.pose[:2])[::-1]) - frame.pose[2]
        np.testing.assert_allclose(frame.action, ahead(away), atol=1e-5)
        assert isinstance(frame.world.boxes, np.ndarray)
    last = frames[-1]
    assert last.outcome == "collision"
    assert last.seconds == pytest.approx(0.2 * len(frames))
    front = last.next_pose[:2] + 0.2 * ahead(last.next_pose[2])  # and not at the next start
    assert np.linalg.norm(front - [0.0, 2.0]) < math.hypot(0.9, 0.4) + 0.265


def test_still_shows_solids_way_end_and_goal(frames, tmp_path):
    drawing.still(Robot(), frames, tmp_path / "episode.png")
    image = imageio.imread(tmp_path / "episode.png")[..., :3] / 255
    assert image.shape[1] == 1120
    pixel, last, middle = looker(image), frames[-1], frames[len(frames) // 2]
    direction = math.atan2(*middle.action[::-1]) + middle.pose[2]
    box = [0, 2] + 0.8 * ahead(math.pi / 6)
    for place, colour in (
        (last.next_pose[:2] - 0.35 * ahead(last.next_pose[2]), drawing.CRASH),
        (last.next_pose[:2] + 0.22 * ahead(last.next_pose[2]), "white"),  # which way it faces
        (middle.pose[:2] + 1.4 * ahead(direction), drawing.ARROW),
        (box, drawing.shade(0.8)),
        ((2.4, -2.0), drawing.shade(1.4)),
        ((6.1, 0.0), drawing.shade(1.5)),
    ):
        assert is_colour(pixel(*place), colour)
    for offset, green in ((0.4, True), (0.6, False)):  # within the goal's radius of 0.5 m and beyond
        red, tint, _ = pixel(last.goal[0], last.goal[1] + offset)
        assert (tint - red > 0.08) == green
    assert not is_colour(pixel(*((frames[1].pose[:2] + frames[2].pose[:2]) / 2)), drawing.FLOOR, 0.1)


def test_a_question_shows_the_first_situation_and_the_direction_in_question(frames, tmp_path):
    turn = 1.0
    state, _ = ENV.reset(jax.random.split(jax.random.key(1))[0])
    first, frame = frames[0], situation(ENV, state, ahead(turn))
    for name in ("pose", "goal", "ranges"):
        np.testing.assert_allclose(getattr(frame, name), getattr(first, name), atol=1e-5)
    drawing.question(Robot(), frame, tmp_path / "question.png")
    pixel, yaw = looker(imageio.imread(tmp_path / "question.png")[..., :3] / 255), frame.pose[2]
    assert is_colour(pixel(*(frame.pose[:2] - 0.35 * ahead(yaw))), drawing.BODY)
    assert is_colour(pixel(*(frame.pose[:2] + 1.4 * ahead(yaw + turn))), drawing.ARROW)
    assert not is_colour(pixel(*(frame.pose[:2] - 0.7 * ahead(yaw + turn))), drawing.ARROW)
