"""The lidar reads what geometry by hand and MuJoCo's rays say, and its faults are those that were asked for."""

import math

import jax
import jax.numpy as jnp
import mujoco_world
import numpy as np
import pytest
import rooms

from cuelearner_envs.navigation import generate, scan
from cuelearner_envs.navigation.lidar import Lidar

AHEAD = 135  # number of the middle beam; neighbours are a degree apart

generate_one = jax.jit(generate, static_argnames="style")
scan_one = jax.jit(scan)
scan_many = jax.jit(jax.vmap(scan, (None, 0)))
read = jax.jit(Lidar.read)
read_many = jax.jit(jax.vmap(Lidar.read, (None, None, 0)))


def world(boxes=(), circles=(), walls=0.0):
    """A world of up to two boxes and two circles, with walls round a square of so many metres if any."""
    return rooms.world([*(rooms.walls(walls, walls) if walls else []), *boxes], circles, rows=(6, 2))


def ranges(solids, x=0.0, y=0.0, yaw=0.0, max_range=10.0):
    return np.asarray(scan_one(solids, jnp.array([x, y, yaw]), max_range), float)


def test_from_inside_a_solid_beams_read_the_way_out():
    box = ranges(world(boxes=[[0.2, 0.0, 0.0, 1.0, 2.0]]))
    assert box[AHEAD] == pytest.approx(1.2, rel=1e-6)
    assert box[AHEAD + 90] == pytest.approx(2.0, rel=1e-6)
    circle = ranges(world(circles=[[0.3, 0.0, 0.5]]))
    assert circle[AHEAD] == pytest.approx(0.8, rel=1e-6)
    assert circle[AHEAD + 90] == pytest.approx(0.4, rel=1e-6)


def test_a_turned_sensor_shifts_the_beams():
    # Turned 15 degrees counterclockwise, its beam n looks where beam n + 15 of a true sensor looks.
    solids, pose = world(boxes=[[3.5, 0.5, 0.3, 0.5, 1.0]], circles=[[1.0, -2.0, 0.5]], walls=9.0), jnp.zeros(3)
    true = np.asarray(read(Lidar(), solids, pose))
    turned = np.asarray(read(Lidar(rotation=math.radians(15)), solids, pose))
    np.testing.assert_allclose(turned[:-15], true[15:], rtol=1e-4)
    assert np.abs(turned - true).max() > 1.0
    column = world(circles=[[3.0 * math.cos(math.radians(15)), 3.0 * math.sin(math.radians(15)), 0.5]])
    assert int(np.argmin(read(Lidar(), column, pose))) == AHEAD + 15
    assert int(np.argmin(read(Lidar(rotation=math.radians(15)), column, pose))) == AHEAD


SQUARE, POSES = world(walls=12.0), jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (200, 3)), jnp.float32)


def test_noise_has_the_deviation_asked_for_and_no_bias():
    true = np.asarray(read_many(Lidar(), SQUARE, POSES), float)
    error = np.asarray(read_many(Lidar(noise=0.05), SQUARE, POSES), float) - true
    error = error[true < 9.5]  # nearer the range it is cut
    assert error.size > 50_000
    assert error.std() == pytest.approx(0.05, rel=0.02)  # its standard error is 0.3%
    assert abs(error.mean()) < 5 * 0.05 / math.sqrt(error.size)
    assert (np.abs(error) < 0.05).mean() == pytest.approx(0.6827, abs=0.01)


def test_drop_outs_read_the_range_at_the_share_asked_for():
    true = np.asarray(read_many(Lidar(), SQUARE, POSES))
    readings = np.asarray(read_many(Lidar(dropout=0.2), SQUARE, POSES))
    assert (true < 9.9).all()
    gone = readings == 10.0
    assert gone.mean() == pytest.approx(0.2, abs=0.01)  # its standard error is 0.17%
    np.testing.assert_allclose(readings[~gone], true[~gone], rtol=1e-6)
    np.testing.assert_array_equal(read_many(Lidar(dropout=1.0, max_range=7.0), SQUARE, POSES), 7.0)


@pytest.mark.parametrize("style", ["clutter", "rooms", "corridor"])
def test_beams_end_where_mujocos_rays_do(style):
    rng = np.random.default_rng(0)
    ours, theirs = [], []
    for number in range(4):
        solids = generate_one(jax.random.fold_in(jax.random.key(5), number), style=style)
        poses = mujoco_world.poses(rng, solids, 4)
        model = mujoco_world.model(solids)
        data = mujoco_world.settled(model)
        ours.append(scan_many(solids, jnp.asarray(poses)))
        theirs.append([mujoco_world.scan(model, data, pose, 10.0) for pose in poses])
    apart = np.abs(np.asarray(ours, float) - np.array(theirs))
    assert (np.array(theirs) < 10.0).mean() > 0.5  # else it says little
    assert (apart <= 1e-3).mean() >= 0.999
