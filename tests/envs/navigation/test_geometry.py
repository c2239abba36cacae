"""Distances to solids are those that a dense sampling of the solids' surfaces finds."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from rooms import world

from cuelearner_envs.navigation.geometry import clearance, in_frame, line_clearance

clearances = jax.jit(jax.vmap(clearance, (None, 0)))
line_clearances = jax.jit(jax.vmap(line_clearance, (None, 0, 0)))


def test_a_point_in_the_frame_of_a_box_by_hand():
    boxes = jnp.array([
        [1.0, 2.0, 0.0, 9.0, 9.0],
        [1.0, 2.0, math.pi / 2, 9.0, 9.0],
        [0.0, 0.0, math.pi / 6, 9.0, 9.0],
        [3.0, 2.0, -1.0, 9.0, 9.0],
    ])  # fmt: skip
    root = math.sqrt(3) / 2
    # From (1, 2) the point (3, 2) is 2 m along x; in a frame turned by 90 degrees that is 2 m along -y.
    expected = [[2.0, 0.0], [0.0, -2.0], [3 * root + 1.0, 2 * root - 1.5], [0.0, 0.0]]
    np.testing.assert_allclose(in_frame(boxes, jnp.array([3.0, 2.0])), expected, atol=1e-6)
    with pytest.raises(TypeCheckError, match="boxes"):  # the checker of shapes is in force
        in_frame(boxes[:, :4], jnp.zeros(2))
    with pytest.raises(TypeCheckError):
        jax.eval_shape(in_frame, boxes, jnp.zeros(3))


def test_clearance_by_hand():
    one = world([[1.0, 0.0, 0.0, 0.5, 2.0]], [[-3.0, 0.0, 1.0]])
    places = [[0.0, 0.0], [0.2, 2.4], [1.0, 0.0], [1.4, 0.0], [-3.0, 0.25], [-1.0, 0.0], [1.5, 1.0]]
    # beside the box; 0.3 and 0.4 off its corner; in its middle, 0.5 from the nearest side; 0.1 inside; in the circle,
    # 0.25 off its centre; halfway nearer the circle; on a side.
    np.testing.assert_allclose(clearances(one, jnp.array(places)), [0.5, 0.5, -0.5, -0.1, -0.75, 1.0, 0.0], atol=1e-6)


def test_line_clearance_by_hand():
    one = world([[0.0, 0.0, 0.0, 1.0, 0.5]], [[0.0, 4.0, 1.0]])
    starts = [[-2.0, 1.0], [-2.0, 0.0], [-3.0, -1.5], [2.0, -0.5], [-2.0, 3.5], [1.3, 0.9], [-2.0, 2.0], [-0.5, 0.0]]
    ends = [[2.0, 1.0], [2.0, 0.0], [3.0, -1.5], [5.0, -0.5], [2.0, 3.5], [1.3, 0.9], [2.0, 1.0], [0.5, 0.1]]
    # past the long side; through the box; below it; away from its flank; through the circle, 0.5 off its centre; a
    # point 0.3 and 0.4 off the corner; slanting past the corner (1, 0.5): the line x + 4 y = 6 is 3 / sqrt(17) away
    # from it, and 10 / sqrt(17) from the circle's centre; within the box.
    expected = [0.5, 0.0, 1.0, 1.0, -0.5, 0.5, 3 / math.sqrt(17), 0.0]
    np.testing.assert_allclose(line_clearances(one, jnp.array(starts), jnp.array(ends)), expected, atol=1e-6)
