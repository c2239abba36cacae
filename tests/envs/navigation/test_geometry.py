"""Distances to solids are those that a dense sampling of the solids' surfaces finds."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import world

from cuelearner_envs.navigation.geometry import clearance, in_frame, line_clearance

SPACING = 0.004  # of the samples on surfaces and lines [m]
SCENES = 4

clearances = jax.jit(jax.vmap(clearance, (None, 0)))
line_clearances = jax.jit(jax.vmap(line_clearance, (None, 0, 0)))


def scene(seed):
    """Five boxes, one of them a slat, and three circles at random; they overlap now and then."""
    rng = np.random.default_rng(seed)
    boxes = np.concatenate(
        [rng.uniform(-4, 4, (5, 2)), rng.uniform(-4, 4, (5, 1)), rng.uniform(0.2, 1.2, (5, 2))], axis=-1
    )
    boxes[0, 4] = 0.03
    circles = np.concatenate([rng.uniform(-4, 4, (3, 2)), rng.uniform(0.1, 0.8, (3, 1))], axis=-1)
    return boxes, circles


def corners(box):
    cos, sin = math.cos(box[2]), math.sin(box[2])
    own = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * box[3:]
    return box[:2] + own @ np.array([[cos, sin], [-sin, cos]])


def between(start, end):
    """Points of a line, `SPACING` apart or less."""
    count = int(np.linalg.norm(end - start) / SPACING) + 2
    return start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)


def surface(solid):
    """Points of the rim of a box (5 numbers) or circle (3)."""
    if len(solid) == 3:
        turns = np.linspace(-np.pi, np.pi, int(2 * np.pi * solid[2] / SPACING) + 2)
        return solid[:2] + solid[2] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    ends = corners(solid)
    return np.concatenate([between(ends[k], ends[k - 1]) for k in range(4)])


def within(points, solid):
    """Which points lie in a solid; for a box: to the left of each of its four sides."""
    if len(solid) == 3:
        return np.linalg.norm(points - solid[:2], axis=-1) < solid[2]
    ends = corners(solid)
    sides = np.roll(ends, -1, axis=0) - ends
    offset = points[:, None] - ends
    return (sides[:, 0] * offset[..., 1] - sides[:, 1] * offset[..., 0] > 0).all(-1)


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


def test_clearance_by_hand():
    one = world([[1.0, 0.0, 0.0, 0.5, 2.0]], [[-3.0, 0.0, 1.0]])
    places = [[0.0, 0.0], [0.2, 2.4], [1.0, 0.0], [1.4, 0.0], [-3.0, 0.25], [-1.0, 0.0], [1.5, 1.0]]
    # beside the box; 0.3 and 0.4 off its corner; in its middle, 0.5 from the nearest side; 0.1 inside; in the circle,
    # 0.25 off its centre; halfway nearer the circle; on a side.
    expected = [0.5, 0.5, -0.5, -0.1, -0.75, 1.0, 0.0]
    np.testing.assert_allclose(clearances(one, jnp.array(places)), expected, atol=1e-6)


@pytest.mark.parametrize("seed", range(SCENES))
def test_clearance_is_the_distance_to_the_nearest_point_of_a_surface(seed):
    boxes, circles = scene(seed)
    points = np.random.default_rng(seed + 100).uniform(-5, 5, (150, 2))
    solids = [*boxes, *circles]
    signed = []
    for solid in solids:
        rim = surface(solid)
        apart = np.linalg.norm(points[:, None] - rim, axis=-1).min(-1)
        signed.append(np.where(within(points, solid), -apart, apart))
    expected = np.min(signed, axis=0)
    ours = np.asarray(clearances(world(boxes, circles), jnp.asarray(points, jnp.float32)), float)
    # A sample is at most half a spacing along the rim from the true foot.
    np.testing.assert_allclose(ours, expected, atol=SPACING / 2 + 1e-5)
    far = expected > 0.1  # the rim bends with a radius of 0.1 at least: the error is (s / 2)^2 / 2 (1 / d + 1 / r)
    np.testing.assert_allclose(ours[far], expected[far], atol=SPACING**2 / 8 * (1 / 0.1 + 1 / 0.1) + 1e-5)
    assert (expected < 0).any()
    assert far.any()


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


@pytest.mark.parametrize("seed", range(SCENES))
def test_line_clearance_is_the_least_clearance_of_the_lines_points(seed):
    boxes, circles = scene(seed)
    rng = np.random.default_rng(seed + 200)
    starts = rng.uniform(-5, 5, (60, 2))
    ends = starts + rng.normal(0, 1.5, (60, 2)) * rng.choice([0.1, 1.0], (60, 1))
    ends[0] = starts[0]
    rims = [surface(solid)[::4] for solid in [*boxes, *circles]]
    expected = []
    for start, end in zip(starts, ends, strict=True):
        points = between(start, end)[::2]
        to_each = []
        for solid, rim in zip([*boxes, *circles], rims, strict=True):
            inside = within(points, solid)
            if len(solid) == 3:  # how deep, where the line enters it
                to_each.append(np.linalg.norm(points - solid[:2], axis=-1).min() - solid[2])
            elif inside.any():
                to_each.append(0.0)
            else:
                to_each.append(np.sqrt(((points[:, None] - rim) ** 2).sum(-1).min()))
        expected.append(min(to_each))
    ours = line_clearances(world(boxes, circles), *(jnp.asarray(x, jnp.float32) for x in (starts, ends)))
    # The samples lie up to 8 mm apart on the line and 16 mm on rims, hence at most 12 mm along them from the true ones.
    np.testing.assert_allclose(ours, expected, atol=0.012)
    assert (np.asarray(ours) < np.array(expected) + 1e-5).all()  # a sample is never nearer than the nearest
    assert min(expected) <= 0 < max(expected)
