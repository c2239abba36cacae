"""Sketches of a table for a browser: balls where they are, films that end as the shot does."""

import math
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from billiards_scenes import balls

from cuelearner_envs.billiards import Table
from cuelearner_envs.billiards.environment import Billiards
from cuelearner_envs.billiards.sketch import TRAIL, TRAIL_SECONDS, _trail, reel, sketch

BOTH = (False, False)  # pocketed
ENV = Billiards(Table.one_ball().replace(max_events=24))


def test_balls_and_the_arrow_are_where_they_should_be_with_y_downwards():
    found = sketch(ENV, balls([[0.1, -0.1], [0.3, 0.15]], BOTH))
    assert found.places == {"ball-0": pytest.approx((0.1, 0.1, 0)), "ball-1": pytest.approx((0.3, -0.15, 0))}
    assert found.foot == pytest.approx((0.1, 0.1))
    assert (found.turn, found.words) == (0.0, "1 of 1 on the table")
    left, top, width, height = found.box
    assert left < -0.4 < 0.4 < left + width
    assert top < -0.2 < 0.2 < top + height
    whole = ElementTree.fromstring(f"<svg>{found.still}{''.join(found.movers.values())}</svg>")
    frame = next(one for one in whole.iter("rect") if "6d4a32" in one.get("style"))
    x, y, wide, high = (float(frame.get(name)) for name in ("x", "y", "width", "height"))
    assert left < x < x + wide < left + width
    assert top < y < y + high < top + height
    assert len([one for one in whole.iter("rect") if "15110e" in one.get("style")]) == 4
    radii = [float(ElementTree.fromstring(f"<g>{body}</g>")[0].get("r")) for body in found.movers.values()]
    assert radii == [0.02, 0.02]
    gone = sketch(ENV, balls([[0.1, -0.1], [0.3, 0.15]], (False, True)))
    assert gone.words == "0 of 1 on the table"
    assert gone.places["ball-1"][1] < -0.2  # beside the table


def test_a_film_ends_as_the_shot_does():
    along = jnp.array([math.cos(math.pi / 4), math.sin(math.pi / 4)])
    state = balls([[0.1, -0.1], [0.3, 0.1]], BOTH)
    film = reel(ENV, state, along)  # the diagonal into the corner
    assert film.words == "1 pocketed"
    assert film.frames[0] == {"ball-0": pytest.approx((0.1, 0.1, 0)), "ball-1": pytest.approx((0.3, -0.1, 0))}
    assert film.frames[-1]["ball-1"] is None
    assert film.frames[-1]["ball-0"] is not None
    assert 0 < film.period * len(film.frames) <= 3.0
    turned = Billiards(ENV.table, action_turn=jnp.array(-math.pi / 4))  # a changed world's film is that world's
    assert reel(turned, state, along).words == "nothing pocketed"


def test_a_trail_is_that_of_the_ball_that_is_hit_though_a_tilted_table_moves_another():
    times = np.linspace(0, TRAIL_SECONDS, TRAIL)
    along = np.stack([times, 0.01 * times**2, np.maximum(times - 1, 0)], 1)  # ball 1 by a tilt, ball 2 hit after 1 s
    drawn = _trail(0.03, 1e-4, np.stack([along, along * 0 + [0, 0.5, -0.25]], -1), np.zeros((TRAIL, 3), bool))
    (dashed,) = [line for line in drawn.split("<polyline")[1:] if "dasharray" in line]
    assert ",0.25 " in dashed  # y points down in pictures
