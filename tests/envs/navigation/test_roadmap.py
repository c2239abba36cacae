"""The road map against networkx and NumPy's own geometry, and the teacher that reads it."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rooms
from probes import long_but
from rooms import to_segments

from cuelearner_envs.navigation.environment import Navigation, Walker
from cuelearner_envs.navigation.layouts import BOXES, CIRCLES
from cuelearner_envs.navigation.roadmap import (
    LINE_MARGIN,
    NODE_MARGIN,
    RoadMapTeacher,
    make_brief_teacher,
    make_teacher,
    way,
)
from cuelearner_envs.navigation.worlds import generate_many
from cuelearner_jax import evaluate
from cuelearner_jax.policies import Taught

REACH = 0.465  # from the middle of the body to its farthest point [m]
NEEDED = REACH + LINE_MARGIN
ROUNDING = 2e-5  # of the map's float32 against float64 here [m]
STYLES = ("clutter", "rooms", "corridor")
ASKED = 40  # places in each world that the teacher is asked about
ROUTES = (0, 5, 11)  # of each world


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def between(a, b, c, d):
    """Distances between the segments ab and cd: zero where they cross, else from an end of one to the other."""
    ends = [to_segments(a, c, d), to_segments(b, c, d), to_segments(c, a, b), to_segments(d, a, b)]
    crossing = (cross(b - a, c - a) * cross(b - a, d - a) < 0) & (cross(d - c, a - c) * cross(d - c, b - c) < 0)
    return np.where(crossing, 0, np.min(ends, axis=0))


def solids(world):
    """Corners (boxes, 4, 2) in turn, and circles (circles, 3)."""
    boxes, circles = np.asarray(world.boxes, float), np.asarray(world.circles, float)
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * boxes[:, None, 3:]
    cos, sin = np.cos(boxes[:, 2])[:, None], np.sin(boxes[:, 2])[:, None]
    x, y = corners[..., 0], corners[..., 1]
    return boxes[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], -1), circles


def room(world, starts, ends):
    """Distance of lines (lines, 2) that begin outside all solids to the nearest solid [m]."""
    corners, circles = solids(world)
    starts, ends = np.asarray(starts, float), np.asarray(ends, float)
    gaps = [to_segments(circle[:2], starts, ends) - circle[2] for circle in circles]
    gaps += [between(starts, ends, box[side], box[(side + 1) % 4]) for box in corners for side in range(4)]
    return np.min(gaps, axis=0)


def clear_of(world, points):
    """Distance from points (points, 2) to the nearest solid; 0 inside one."""
    return rooms.distance(np.asarray(points, float), np.asarray(world.boxes, float), np.asarray(world.circles, float))


def gate(side):
    """16 m by 12 m, cut in two at x = 0 by a wall with one gap of 2 m: to the left (1) or to the right (-1)."""
    # From one side wall to 3 m beyond the middle, and from 5 m to the other side wall.
    pieces = [[0.0, -1.5 * side, 0, 0.1, 4.5], [0.0, 5.5 * side, 0, 0.1, 0.5]]
    starts, goals = [[-4.0, 0.0], [4.0, -3.0]] * 8, [[4.0, 0.0], [4.0, 3.0]] * 8
    boxes = [*rooms.walls(16.0, 12.0), *pieces]
    return rooms.world(boxes, (), (16.0, 12.0), starts, goals, heights=1.5, rows=(BOXES, CIRCLES))


WORLDS = range(2 * len(STYLES))
GATES = {6: 1, 7: -1}  # worlds with the gap on the left and on the right


@pytest.fixture(scope="module")
def teacher() -> RoadMapTeacher:
    """Two worlds of each style, then the two gates."""
    made = [generate_many(jax.random.key(3), 8, style) for style in STYLES]  # eight, as other tests have compiled
    worlds = [jax.tree.map(lambda leaf: leaf[:2], many) for many in made]
    worlds += [jax.tree.map(lambda leaf: leaf[None], gate(side)) for side in GATES.values()]
    together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *worlds)
    return make_teacher(Navigation(worlds=together, max_steps=jnp.int32(160)))


def one(tree, index):
    return jax.tree.map(lambda leaf: np.asarray(leaf[index]), tree)


def useful(roadmap):
    return np.isfinite(roadmap.lengths).any(-1)


@pytest.mark.parametrize("index", long_but((0, 2), WORLDS))
def test_nodes_are_joined_where_the_inflated_body_can_walk_and_nowhere_else(teacher, index):
    world, roadmap = one(teacher.env.worlds, index), one(teacher.maps, index)
    nodes = np.flatnonzero(useful(roadmap))
    assert len(nodes) > 60
    places = roadmap.nodes[nodes].astype(float)
    assert clear_of(world, places).min() >= REACH + NODE_MARGIN - 2e-4
    assert (np.abs(places) < world.extent / 2).all()
    np.testing.assert_array_equal(roadmap.lengths, roadmap.lengths.T)
    a, b = np.triu_indices(len(nodes), 1)
    gaps, lengths = room(world, places[a], places[b]), roadmap.lengths[nodes[a], nodes[b]]
    joined = np.isfinite(lengths)
    assert gaps[joined].min() >= NEEDED - ROUNDING
    assert gaps[~joined].max() <= NEEDED + ROUNDING
    np.testing.assert_allclose(lengths[joined], np.linalg.norm(places[a] - places[b], axis=-1)[joined], atol=1e-5)
    assert 0.02 < joined.mean() < 0.9


@jax.jit
def ways(teacher, index, route, positions):
    """The next place and the length of the way from positions (n, 2) of a world to a route's goal."""
    world, roadmap = jax.tree.map(lambda leaf: leaf[index], (teacher.env.worlds, teacher.maps))
    ask = partial(way, roadmap, world, teacher.env.robot, teacher.to_goals[index, route])
    return jax.vmap(lambda position: ask(position, world.goals[route]))(positions)


def free_places(world, seed, count=ASKED, spare=0.01):
    """Random places at which the body may turn and a line need not come closer to a solid."""
    places = np.random.default_rng(seed).uniform(-0.5, 0.5, (2000, 2)) * world.extent
    return places[clear_of(world, places) >= NEEDED + spare][:count].astype(np.float32)


best = jax.jit(lambda teacher, states: jax.vmap(lambda state: teacher.best_action(state, jnp.zeros(280)))(states))
observe = jax.jit(lambda env, states: jax.vmap(env.observe)(states))


def walkers(world, index, route, places, yaws):
    count = len(places)
    number = partial(jnp.full, (count,), dtype=jnp.int32)
    poses = jnp.concatenate([jnp.asarray(places), jnp.asarray(yaws, jnp.float32)[:, None]], -1)
    goals = jnp.tile(world.goals[route], (count, 1))
    nothing = jnp.zeros((count, 3, 2))
    return Walker(poses, jnp.zeros((count, 2)), goals, nothing, number(index), number(route), number(0))


@pytest.mark.parametrize("index", long_but((0, 2), WORLDS))
def test_the_teacher_points_at_the_next_place_in_the_bodys_frame(teacher, index):
    world, route = one(teacher.env.worlds, index), ROUTES[0]
    places = free_places(world, 200 + index)
    yaws = np.linspace(-3, 3, ASKED)
    states = walkers(world, index, route, places, yaws)
    answers = np.asarray(best(teacher, states), float)
    np.testing.assert_allclose(np.linalg.norm(answers, axis=-1), 1, atol=1e-5)
    following, _ = ways(teacher, index, route, places)
    offset = np.asarray(following, float) - places
    expected = np.arctan2(offset[:, 1], offset[:, 0]) - yaws
    np.testing.assert_allclose(answers, np.stack([np.cos(expected), np.sin(expected)], -1), atol=1e-4)
    sees = room(world, places, np.tile(world.goals[route], (ASKED, 1))) >= NEEDED + ROUNDING
    assert sees.any()
    toward = jax.vmap(teacher.env.heuristic)(observe(teacher.env, states))
    np.testing.assert_allclose(answers[sees], np.asarray(toward)[sees], atol=1e-4)


@pytest.mark.long
def test_a_map_that_is_made_when_asked_answers_as_one_that_is_kept(teacher):
    """Up to rounding, by which another of two ways that are as long may be the shortest."""
    brief, found = make_brief_teacher(teacher.env), []
    answers = jax.jit(lambda states: jax.lax.map(lambda state: brief.best_action(state, jnp.zeros(280)), states))
    for index in range(3):
        world = one(teacher.env.worlds, index)
        states = walkers(world, index, 0, free_places(world, index), np.full(ASKED, 0.3))
        found.append(np.abs(np.asarray(answers(states)) - np.asarray(best(teacher, states))).max(-1))
    assert np.mean(np.concatenate(found) < 1e-3) > 0.98


@pytest.mark.long
def test_whoever_follows_the_teacher_arrives(teacher):
    measure = jax.jit(lambda teacher, key: evaluate.evaluate_policy(teacher.env, Taught(teacher), key, 24, 24 * 160))
    found = {name: float(value) for name, value in measure(teacher, jax.random.key(5)).items()}
    assert found["finished"] == 1
    assert found["success"] >= 23 / 24
    assert found["duration"] < 20


def test_the_way_through_the_gap_is_as_long_as_it_has_to_be(teacher):
    # The shortest that keeps a line's distance: tangents of sqrt(3.9^2 + 3^2 - 0.545^2) m to an arc round either corner
    # of the wall's end, 0.2 m between the arcs, which together turn by twice 43.93 degrees.
    shortest = 2 * math.sqrt(3.9**2 + 3.0**2 - NEEDED**2) + 0.2 + NEEDED * math.radians(2 * 43.93)
    for index, side in GATES.items():
        following, length = ways(teacher, index, 0, jnp.tile(jnp.array([-4.0, 0.0]), (ASKED, 1)))
        assert shortest - 1e-3 < float(length[0]) < 1.1 * shortest
        assert 3.0 < side * float(following[0, 1]) < 5.0
