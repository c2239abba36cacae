"""Billiards drawings, looked at pixel by pixel: balls are where they should be, films last as long as the shots."""

import math

import imageio.v2 as imageio
import numpy as np
import pytest
from pictures import is_colour

from cuelearner_envs.billiards import Table, drawing, sketch

TABLE = Table.one_ball().replace(max_events=24)


@pytest.mark.parametrize(("angle", "pocketed"), [(1.0, False), (-2.5, True)])
def test_a_question_shows_the_balls_and_the_shot_as_an_arrow(tmp_path, angle, pocketed):
    cue, target = np.array([-0.1, 0.02]), np.array([0.2, 0.1])
    ahead = np.array([math.cos(angle), math.sin(angle)])
    drawing.question(TABLE, np.stack([cue, target]), np.array([False, pocketed]), ahead, tmp_path / "question.png")
    image = imageio.imread(tmp_path / "question.png")[..., :3] / 255
    assert image.shape[1] == 1280
    left, right, _, top = drawing.limits(TABLE)
    dots = image.shape[1] / (right - left)  # in a metre
    beside = target + np.array([0.0, 0.012])  # the number, inside the ball
    for place, colour in (
        (cue, sketch.CUE),
        (beside, sketch.CLOTH if pocketed else sketch.TARGETS[0]),
        (cue + 0.05 * ahead, drawing.ARROW),
        (cue - 0.05 * ahead, sketch.CLOTH),
        ((0.0, 0.2), sketch.CUSHION),
        ((0.41, 0.21), sketch.HOLE),
    ):
        assert is_colour(image[int((top - place[1]) * dots), int((place[0] - left) * dots)], colour, 0.1)
    rows, _ = np.nonzero(is_colour(image, sketch.TARGETS[0]))
    assert (rows.min() > (top + 0.2) * dots) == pocketed  # then all of the ball is below the table
