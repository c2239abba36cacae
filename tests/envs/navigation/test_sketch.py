"""Sketches of a robot's surroundings for a browser: the robot faces up, films end where walking leads."""

import math
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import room

from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.sketch import STEPS, reel, sketch

ENV = Navigation(jax.tree.map(lambda leaf: leaf[None], room([[-4.0, 0.0]], [[4.0, 0.0]])))


def standing(x, y, yaw, goal):
    index = jnp.zeros((), jnp.int32)
    return ENV.placed(jnp.array([x, y, yaw]), jnp.array(goal), jnp.zeros((3, 2)), index, index)


def shapes(found, colour):
    """Elements of a colour."""
    whole = ElementTree.fromstring(f"<svg>{found.still}</svg>")
    return [one for one in whole.iter() if f"--{colour}" in one.get("style", "")]


def test_what_lies_ahead_is_above_and_what_lies_to_the_left_is_on_the_left():
    for yaw in (0.0, 1.0, math.pi / 2):
        ahead, left = 2.0, 1.5
        goal = [-2.0 + ahead * math.cos(yaw) - left * math.sin(yaw), ahead * math.sin(yaw) + left * math.cos(yaw)]
        found = sketch(ENV, standing(-2.0, 0.0, yaw, goal))
        star = shapes(found, "goal")[-1]
        np.testing.assert_allclose([float(star.get("cx")), float(star.get("cy"))], [-left, -ahead], atol=1e-3)
        assert found.words == "2.5 m from the goal"
        assert (found.foot, found.turn, found.places["robot"]) == ((0.0, 0.0), 90.0, (0.0, 0.0, -90.0))
    # The wall behind a robot that looks along x is below it, 4 m away: its near face.
    walls = [one.get("points") for one in shapes(sketch(ENV, standing(-2.0, 0.0, 0.0, [4.0, 0.0])), "solid")]
    lows = [min(float(point.split(",")[1]) for point in wall.split()) for wall in walls if wall]
    assert any(abs(low - 4.0) < 1e-3 for low in lows)


def test_a_film_walks_where_the_direction_leads():
    film = reel(ENV, standing(-4.0, 0.0, 0.0, [4.0, 0.0]), jnp.array([0.0, 1.0]))
    assert film.frames[0]["robot"] == (0.0, 0.0, -90.0)
    x, y, turn = film.frames[-1]["robot"]
    assert x < -1.5  # to the left on the screen
    assert abs(y) < 0.1
    assert turn == pytest.approx(-180.0, abs=1.0)  # its head turned there
    free = reel(ENV, standing(-4.0, 0.0, 0.0, [4.0, 0.0]), jnp.array([1.0, 0.0]))
    assert free.words == "held for 3.0 s: the way is free"
    assert len(free.frames) == STEPS + 1
    into = reel(ENV, standing(-5.0, 0.0, math.pi, [4.0, 0.0]), jnp.array([1.0, 0.0]))
    assert into.words.endswith("collision")
    assert len(into.frames) < STEPS
    assert reel(ENV, standing(3.0, 0.0, 0.0, [4.0, 0.0]), jnp.array([1.0, 0.0])).words.endswith("the goal is reached")
