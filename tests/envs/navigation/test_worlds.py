"""Generated worlds keep their promises, in dozens of each style: NumPy and SciPy look at every one."""

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import long_but
from rooms import distance, to_box, to_circle, used
from scipy import ndimage

from cuelearner_envs.navigation import generate
from cuelearner_envs.navigation.worlds import any_of, generate_many

KEYS = 40
STYLES = ("clutter", "rooms", "corridor")
REACH = 0.2 + 0.265  # of the body: its front disc's offset and radius [m]
GRID = 0.1  # between nodes [m]
# Where two neighbouring nodes keep this, every point of the line between them keeps the reach: from any point p, the
# squared distance to the line's middle is the mean of those to its ends less (GRID / 2)^2.
NEEDED = math.hypot(REACH, GRID / 2)


# Runs 120 times: optimising it costs less than it saves.
OPTIMISED = {"xla_backend_optimization_level": 1}
generate_one = jax.jit(generate, static_argnames="style", compiler_options=OPTIMISED)


@pytest.fixture(scope="module", params=long_but(["rooms"], STYLES))
def sample(request):
    """Dozens of worlds of a style, as numpy arrays: those of `generate_many`, one at a time on two threads."""
    keys = list(jax.vmap(partial(jax.random.fold_in, jax.random.key(3)))(jnp.arange(KEYS)))
    generate_one(keys[0], style=request.param)
    with ThreadPoolExecutor(2) as threads:
        worlds = list(threads.map(lambda key: jax.device_get(generate_one(key, style=request.param)), keys))
    return request.param, jax.tree.map(lambda *leaves: np.stack(leaves).astype(float), *worlds)


def walkable(boxes, circles, extent):
    """The nodes from which every solid is at least `NEEDED` away, and the first node's place."""
    count = np.ceil(extent / GRID).astype(int) + 1
    first = -(count - 1) / 2 * GRID
    axes = [first[k] + np.arange(count[k]) * GRID for k in (0, 1)]
    free = np.ones(count, bool)
    solids = [(box, math.hypot(box[3], box[4]), to_box) for box in boxes]
    solids += [(circle, circle[2], to_circle) for circle in circles]
    for solid, radius, to_solid in solids:
        low = np.clip(np.floor((solid[:2] - radius - NEEDED - first) / GRID).astype(int), 0, count)
        high = np.clip(np.ceil((solid[:2] + radius + NEEDED - first) / GRID).astype(int) + 1, 0, count)
        nearby = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        places = np.stack(np.meshgrid(axes[0][nearby[0]], axes[1][nearby[1]], indexing="ij"), axis=-1)
        free[nearby] &= to_solid(places, solid) >= NEEDED
    inside = [np.abs(axis) < side / 2 for axis, side in zip(axes, extent, strict=True)]
    return free & inside[0][:, None] & inside[1], first


def joined(free, first, starts, goals):
    """Whether the nodes nearest to each start and its goal are free and in one piece."""
    pieces, _ = ndimage.label(free)  # over the sides of cells, not their corners
    ends = [pieces[tuple(np.round((places - first) / GRID).astype(int).T)] for places in (starts, goals)]
    return (ends[0] == ends[1]) & (ends[0] > 0)


def each(many):
    """Used boxes, used circles, starts, goals and extent, world by world."""
    rows = zip(many.boxes, many.circles, many.starts, many.goals, many.extent, strict=True)
    for boxes, circles, starts, goals, extent in rows:
        yield used(boxes), used(circles), starts, goals, extent


@pytest.mark.long
def test_every_goal_can_be_reached_by_the_body_however_it_is_turned(sample):
    _, many = sample
    for number, (boxes, circles, starts, goals, extent) in enumerate(each(many)):
        reached = joined(*walkable(boxes, circles, extent), starts, goals)
        assert reached.all(), f"world {number}, routes {np.flatnonzero(~reached)}"


def test_starts_and_goals_are_clear_of_solids_and_inside_the_walls(sample):
    _, many = sample
    for boxes, circles, starts, goals, extent in each(many):
        places = np.concatenate([starts, goals])
        assert distance(places, boxes, circles).min() >= REACH
        assert (np.abs(places) < extent / 2 - REACH).all()


def test_goals_lie_5_to_15_m_from_their_starts(sample):
    _, many = sample
    apart = np.linalg.norm(many.goals - many.starts, axis=-1)
    assert apart.shape == (KEYS, 16)
    assert apart.min() >= 5.0
    assert apart.max() <= 15.0
    assert apart.min() < 5.5
    assert apart.max() > 14.5


@pytest.mark.long
@pytest.mark.parametrize("sample", ["corridor"], indirect=True)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_every_obstacle_of_a_corridor_can_be_passed_on_either_side(sample, side):
    _, many = sample
    ends = np.array([[-9.0, 0.0]]), np.array([[9.0, 0.0]])
    for boxes, circles, _, _, extent in each(many):
        centres = np.concatenate([boxes[4:, :2], circles[:, :2]])
        assert (np.abs(centres[:, 1]) <= 0.15 + 1e-6).all()
        assert np.diff(np.sort(centres[:, 0])).min() > 2.9  # nobody has to pass between two at once
        # From each centre a wall to one side closes that side.
        closed = [[x, y - side * 2.0, 0.0, 0.01, 2.0] for x, y in centres]
        assert joined(*walkable(np.concatenate([boxes, closed]), circles, extent), *ends).all()


@pytest.mark.long
@pytest.mark.parametrize("sample", ["rooms"], indirect=True)
@pytest.mark.parametrize("at_once", [None, 3, 64])
def test_worlds_generated_together_are_those_generated_alone(sample, monkeypatch, at_once):
    style, many = sample
    monkeypatch.setattr("cuelearner_envs.navigation.worlds.together", lambda: at_once)
    together = jax.jit(lambda key: generate_many.__wrapped__(key, 8, style))(jax.random.key(3))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[:8], atol=1e-5), together, many)


def test_a_usable_cell_is_drawn_as_a_categorical_draws_it():
    keys, usable = jax.random.split(jax.random.key(0), 200), jax.random.bernoulli(jax.random.key(1), 0.3, (200, 1000))
    usable = usable.at[0].set(False)
    weights = jnp.where(usable, 0.0, -jnp.inf)
    np.testing.assert_array_equal(jax.vmap(any_of)(keys, usable), jax.vmap(jax.random.categorical)(keys, weights))
