"""Billiards drawings, looked at pixel by pixel: balls are where they should be, films last as long as the shots."""

import math
from xml.etree import ElementTree

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pictures import film, is_colour

from cuelearner_envs.billiards import Table, drawing, trace

TABLE = Table.one_ball().replace(max_events=24)
FRAME = 0.03  # of a GIF at 30 frames a second [s]


@pytest.fixture(scope="module")
def shot():
    """The cue ball at (0.1, -0.1) drives the target at (0.3, 0.1) along the diagonal into the corner (0.4, 0.2)."""
    positions = jnp.array([[0.1, -0.1], [0.3, 0.1]])
    path = jax.jit(trace)(TABLE, positions, jnp.zeros(2, bool), math.pi / 4)
    assert path.pocketed[-1].tolist() == [False, True]
    return path


def drawn(draw):
    """Draws on axes of their own; returns these, the picture and a function that looks it up in table coordinates."""
    figure = Figure(figsize=(8, 5), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    draw(axes)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., :3] / 255

    def pixel(x, y):
        column, row = axes.transData.transform((x, y))
        return image[image.shape[0] - 1 - int(row), int(column)]

    return axes, image, pixel


def test_balls_lie_where_they_are_and_a_pocketed_one_not_on_the_cloth():
    off = 0.6 * 0.02  # beside the number, inside the ball
    positions = np.array([[-0.2, 0.0], [0.2, 0.1]])

    _, _, pixel = drawn(lambda axes: drawing.draw_table(axes, TABLE, positions, np.array([False, False])))
    assert is_colour(pixel(-0.2, 0.0), drawing.CUE)
    assert is_colour(pixel(0.2, 0.1 + off), drawing.TARGETS[0])
    assert is_colour(pixel(0.0, 0.0), drawing.CLOTH)
    assert is_colour(pixel(0.0, 0.2), drawing.CUSHION)
    assert is_colour(pixel(0.41, 0.21), drawing.HOLE)

    axes, image, pixel = drawn(lambda axes: drawing.draw_table(axes, TABLE, positions, np.array([False, True])))
    assert is_colour(pixel(0.2, 0.1 + off), drawing.CLOTH)
    rows, _ = np.nonzero(is_colour(image, drawing.TARGETS[0]))
    edge = image.shape[0] - axes.transData.transform((0, -0.2))[1]
    assert len(rows) > 50
    assert rows.min() > edge  # all of the ball is below the table


@pytest.mark.parametrize("angle", [1.0, -2.5])
def test_a_question_shows_the_balls_and_the_shot_as_an_arrow(tmp_path, angle):
    positions, ahead = np.array([[-0.1, 0.02], [0.3, 0.1]]), np.array([math.cos(angle), math.sin(angle)])
    drawing.question(TABLE, positions, np.array([False, False]), ahead, tmp_path / "question.png")
    image = imageio.imread(tmp_path / "question.png")[..., :3] / 255
    assert image.shape[1] == 1280
    left, right, _, top = drawing._limits(TABLE)

    def pixel(place):
        dots = image.shape[1] / (right - left)  # in a metre
        return image[int((top - place[1]) * dots), int((place[0] - left) * dots)]

    assert is_colour(pixel(positions[0]), drawing.CUE)
    assert is_colour(pixel(positions[1] + [0.0, 0.012]), drawing.TARGETS[0])
    assert is_colour(pixel(positions[0] + 0.05 * ahead), drawing.ARROW, 0.1)
    assert is_colour(pixel(positions[0] - 0.05 * ahead), drawing.CLOTH)


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_still_is_a_picture_and_repeats(shot, tmp_path, suffix):
    files = [tmp_path / f"{name}.{suffix}" for name in ("one", "two")]
    for file in files:
        drawing.still(TABLE, shot, file)
    assert files[0].read_bytes() == files[1].read_bytes()
    if suffix == "svg":
        assert ElementTree.parse(files[0]).getroot().tag.endswith("svg")
        return
    image = imageio.imread(files[0])[..., :3] / 255
    assert image.shape[1] == 1280
    for name, least in ((drawing.CLOTH, 0.3), (drawing.ARROW, 1e-4), (drawing.TARGETS[0], 1e-3)):
        assert is_colour(image, name).mean() > least


def test_gif_has_the_frames_of_the_shot_and_lasts_as_long(shot, tmp_path):
    duration = float(shot.times[-1])
    held = round(drawing.HOLD_BEFORE / FRAME) + round(drawing.HOLD_AFTER / FRAME)
    for speed in (1.0, 2.0):
        drawing.animate(TABLE, [shot], tmp_path / "shot.gif", speed=speed)
        pictures, durations = film(tmp_path / "shot.gif")
        moving = math.ceil(duration / speed / FRAME) + 1
        assert durations.sum() == pytest.approx((held + moving) * FRAME)
        assert 0.6 * moving < len(pictures) <= moving + 2  # equal pictures are stored once
        assert {picture.shape for picture in pictures} == {pictures[0].shape}
        assert durations[0] == pytest.approx(drawing.HOLD_BEFORE, abs=1.1 * FRAME)

    def share(picture, name):
        return is_colour(picture, name, 0.06).mean()

    assert share(pictures[0], drawing.ARROW) > 1e-4  # before the shot only
    assert share(pictures[-1], drawing.ARROW) < 2e-5
    assert pictures[-1][-1, -1].tolist() == [1, 1, 1]  # white stays white on a page
    below = pictures[0].shape[0] * 0.88  # the tray: empty at first, then with the target
    assert share(pictures[0][int(below) :], drawing.TARGETS[0]) == 0
    assert share(pictures[-1][int(below) :], drawing.TARGETS[0]) > 1e-3
    assert share(pictures[-1][: int(below)], drawing.TARGETS[0]) == 0
