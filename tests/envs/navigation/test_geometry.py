"""Distances to solids are those that a dense sampling of the solids' surfaces finds."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from rooms import world

from cuelearner_envs.navigation.geometry import clearance, line_clearance

clearances = jax.jit(jax.vmap(clearance, (None, 0)))
line_clearances = jax.jit(jax.vmap(line_clearance, (None, 0, 0)))


def test_clearance_by_hand():
    one = world([[1.0, 0.0, 0.0, 0.5, 2.0]], [[-3.0, 0.0, 1.0]])
    places = [[0.0, 0.0], [0.2, 2.4], [1.0, 0.0], [1.4, 0.0], [-3.0, 0.25], [-1.0, 0.0], [1.5, 1.0]]
    # beside the box; 0.3 and 0.4 off its corner; in its middle, 0.5 from the nearest side; 0.1 inside; in the circle,
    # 0.25 off its centre; halfway nearer the circle; on a side.
    expected = [0.5, 0.5, -0.5, -0.1, -0.75, 1.0, 0.0]
    np.testing.assert_allclose(clearances(one, jnp.array(places)), expected, atol=1e-6)


def test_line_clearance_by_hand():
    one = world([[0.0, 0.0, 0.0, 1.0, 0.5]], [[0.0, 4.0, 1.0]])
    starts = [[-2.0, 1.0], [-2.0, 0.0], [-3.0, -1.5], [2.0, -0.5], [-2.0, 3.5], [1.3, 0.9], [-2.0, 2.0], [-0.5, 0.0]]
    ends = [[2.0, 1.0], [2.0, 0.0], [3.0, -1.5], [5.0, -0.5], [2.0, 3.5], [1.3, 0.9], [2.0, 1.0], [0.5, 0.1]]
    # past the long side; through the box; below it; away from its flank; through the circle, 0.5 off its centre; a
    # point 0.3 and 0.4 off the corner; slanting past the corner (1, 0.5): the line x + 4 y = 6 is 3 / sqrt(17) away
    # from it, and 10 / sqrt(17) from the circle's centre; within the box.
    expected = [0.5, 0.0, 1.0, 1.0, -0.5, 0.5, 3 / math.sqrt(17), 0.0]
    got = line_clearances(one, jnp.array(starts), jnp.array(ends))
    np.testing.assert_allclose(got, expected, atol=1e-6)
