"""Navigation pictures, looked at pixel by pixel, and the records behind them: what is drawn is what happened."""

import math
from typing import Any

import imageio.v2 as imageio
import jax
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from pictures import film, is_colour
from rooms import room

from cuelearner_envs.navigation import drawing, scan
from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.recording import record, situation
from cuelearner_envs.navigation.robot import Robot
from cuelearner_jax.policies import Heuristic

STEPS = 80
BODY = {"success": drawing.BODY, "collision": drawing.CRASH}


def environment(starts, goals, **fields):
    return Navigation(worlds=jax.tree.map(lambda leaf: leaf[None], room(starts, goals)), **fields)


ENVIRONMENTS = {
    "success": environment([[-3.5, 0.0]], [[4.0, 0.0]]),
    "collision": environment([[-5.5, 2.0]], [[4.0, 2.0]]),
    "timeout": environment([[-4.0, 0.0]], [[4.0, 0.0]], max_steps=7),
}


@pytest.fixture(scope="module")
def records():
    """Frames and rewards of walking straight to the goal, by how the episodes end."""
    return {name: record(env, Heuristic(env), jax.random.key(1), STEPS) for name, env in ENVIRONMENTS.items()}


def looker(image, strip):
    """A function that looks up a picture with a strip of dots below it at a place in the room [m]."""
    dots = image.shape[1] / (12.0 + 2 * drawing.MARGIN)  # in a metre

    def pixel(x, y):
        middle = (image.shape[0] - strip) / 2
        return image[round(middle - y * dots), round(image.shape[1] / 2 + x * dots)]

    return pixel


def test_an_episode_ends_where_it_ends_not_where_the_next_begins(records):
    last = next(frame for frame in records["success"][0] if frame.outcome)
    assert np.linalg.norm(last.next_pose[:2] - last.goal) < last.goal_radius == 0.5
    np.testing.assert_array_equal(last.goal, [4.0, 0.0])
    assert last.seconds == pytest.approx(7.1, abs=0.21)  # 7 m at 1 m/s and the lag
    timeout = next(frame for frame in records["timeout"][0] if frame.outcome)
    assert timeout.seconds == pytest.approx(1.4)


def test_a_frame_holds_what_was_seen_and_chosen_at_its_pose(records):
    for frame in records["collision"][0][3:9:3]:
        np.testing.assert_allclose(frame.ranges, scan(frame.world, frame.pose), rtol=1e-5)
        ahead = math.atan2(*(frame.goal - frame.pose[:2])[::-1]) - frame.pose[2]
        np.testing.assert_allclose(frame.action, [math.cos(ahead), math.sin(ahead)], atol=1e-5)
        assert isinstance(frame.world.boxes, np.ndarray)
        assert frame.world.boxes.shape == (6, 5)


def test_solids_are_where_the_world_has_them_in_the_shade_of_their_height():
    figure = Figure(figsize=(8, 6), dpi=100)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    drawing.draw_world(axes, room([[0, 0]], [[1, 0]]))
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., :3] / 255

    def pixel(x, y):
        column, row = axes.transData.transform((x, y))
        return image[image.shape[0] - 1 - int(row), int(column)]

    along = np.array([math.cos(math.pi / 6), math.sin(math.pi / 6)])
    assert is_colour(pixel(*([0, 2] + 0.8 * along)), drawing.shade(0.8))
    assert is_colour(pixel(*([0, 2] + 1.0 * along)), drawing.FLOOR)
    assert is_colour(pixel(0.8, 2.0), drawing.FLOOR)  # inside the box if it were not turned
    assert is_colour(pixel(2.4, -2.0), drawing.shade(1.4))
    assert is_colour(pixel(2.6, -2.0), drawing.FLOOR)
    for x, y in ((6.1, 0), (-6.1, 1), (0, 4.1), (3, -4.1)):
        assert is_colour(pixel(x, y), drawing.shade(1.5))
    assert len(axes.patches) == 1 + 4 + 1 + 1  # the floor; nothing for the rows that fill the arrays
    assert sum(to_rgb(drawing.shade(1.4))) < sum(to_rgb(drawing.shade(0.8))) < sum(to_rgb(drawing.FLOOR))


@pytest.mark.parametrize("name", ["success", "collision"])
def test_still_shows_start_way_end_and_goal(records, tmp_path, name):
    frames, _ = records[name]
    drawing.still(Robot(), frames, tmp_path / "episode.png")
    image = imageio.imread(tmp_path / "episode.png")[..., :3] / 255
    assert image.shape[1] == 1120
    pixel = looker(image, drawing.STRIP_INCHES * 160)
    last = next(frame for frame in frames if frame.outcome)
    pose = last.next_pose
    ahead = np.array([math.cos(pose[2]), math.sin(pose[2])])
    assert is_colour(pixel(*(pose[:2] - 0.35 * ahead)), BODY[name])
    assert is_colour(pixel(*(pose[:2] + 0.22 * ahead)), "white")  # which way it faces
    for offset, green in ((0.4, True), (0.6, False)):  # within the goal's radius of 0.5 m and beyond
        red, tint, _ = pixel(last.goal[0], last.goal[1] + offset)
        assert (tint - red > 0.08) == green
    way = [frame for frame in frames if frame.episode == 0]
    between = (way[1].pose[:2] + way[2].pose[:2]) / 2
    assert not is_colour(pixel(*between), drawing.FLOOR, 0.1)
    middle = way[len(way) // 2]
    direction = math.atan2(*middle.action[::-1]) + middle.pose[2]
    tip = middle.pose[:2] + 1.4 * np.array([math.cos(direction), math.sin(direction)])
    assert is_colour(pixel(*tip), drawing.ARROW)


@pytest.mark.parametrize("turn", [0.5, -2.0])
def test_a_question_shows_the_first_situation_and_the_direction_in_question(records, tmp_path, turn):
    env, first = ENVIRONMENTS["success"], records["success"][0][0]
    state, _ = env.reset(jax.random.split(jax.random.key(1))[0])
    frame = situation(env, state, np.array([math.cos(turn), math.sin(turn)]))
    for name in ("pose", "goal", "ranges"):
        np.testing.assert_allclose(getattr(frame, name), getattr(first, name), atol=1e-5)
    assert (frame.outcome, frame.seconds) == ("", 0.0)
    drawing.question(Robot(), frame, tmp_path / "question.png")
    image = imageio.imread(tmp_path / "question.png")[..., :3] / 255
    assert image.shape[1] == 1120
    pixel = looker(image, drawing.STRIP_INCHES * 160)
    yaw = frame.pose[2]
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    asked = np.array([math.cos(yaw + turn), math.sin(yaw + turn)])
    assert is_colour(pixel(*(frame.pose[:2] - 0.35 * ahead)), drawing.BODY)
    assert is_colour(pixel(*(frame.pose[:2] + 1.4 * asked)), drawing.ARROW)
    assert not is_colour(pixel(*(frame.pose[:2] - 1.4 * asked)), drawing.ARROW)
    red, green, _ = pixel(frame.goal[0], frame.goal[1] + 0.4)
    assert green - red > 0.08


def test_gif_shows_each_step_and_then_the_end(records, tmp_path):
    frames, _ = records["collision"]
    frames = [frame for frame in frames if frame.episode < 2]
    drawing.animate(Robot(), frames, tmp_path / "film.gif")
    pictures, durations = film(tmp_path / "film.gif")
    assert len(pictures) == len(frames) + 2  # equal pictures are stored once
    assert durations.sum() == pytest.approx(len(frames) * 0.1 + 2 * drawing.HOLD_AFTER)
    assert {picture.shape[1] for picture in pictures} == {700}
    end = 1 + next(number for number, frame in enumerate(frames) if frame.outcome)
    assert durations[end - 1 : end + 2] == pytest.approx([0.1, drawing.HOLD_AFTER, 0.1])

    strip = drawing.STRIP_INCHES * 100
    before, ended = frames[end - 1].pose[:2], frames[end - 1].next_pose[:2]
    assert is_colour(looker(pictures[end - 1], strip)(*before), drawing.BODY)
    assert is_colour(looker(pictures[end], strip)(*ended), drawing.CRASH)
    assert looker(pictures[end + 1], strip)(*ended).min() > 0.8  # a new episode: bare floor, or seen by the lidar
    shown = [is_colour(picture[: -int(strip)], drawing.ARROW).mean() for picture in pictures]
    assert shown[end] == 0
    assert min(shown[:end]) > 1e-4
    assert pictures[-1][-1, -1].tolist() == [1, 1, 1]  # white stays white on a page
