"""Where the quadruped is looked at from. (Its films are made by the command line's tests.)"""

import math

import mujoco
import numpy as np
import pytest

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.scene import AZIMUTH, SIDES_APART, furnish, unobstructed
from cuelearner_envs.navigation import World

STANDING = [0, 0, robot.STANDING_HEIGHT, 1, 0, 0, 0, *robot.HOME]


def looked_at(*circles):
    """The camera for a robot at the origin among circles (x, y, radius) [m] of 1.5 m."""
    rows, heights = np.array([*circles, (9.0, 9.0, 0.1)]), np.full(len(circles) + 1, 1.5)
    nothing = np.zeros((0, 5)), np.zeros(0)
    world = World(*nothing, rows, heights, np.full(2, 20.0), np.zeros((1, 2)), np.zeros((1, 2)))
    model = furnish(world, np.array([0.0, 0.0]), 0.5)
    data = mujoco.MjData(model)
    data.qpos[:] = STANDING
    mujoco.mj_forward(model, data)
    return unobstructed(model, data)


def toward(azimuth, distance):
    """Where a camera that looks along an azimuth [deg] stands, at a distance from the origin [m]."""
    return -distance * math.cos(math.radians(azimuth)), -distance * math.sin(math.radians(azimuth))


def test_it_is_seen_from_the_usual_side_where_nothing_stands_there():
    assert looked_at().azimuth == AZIMUTH
    assert looked_at((*toward(AZIMUTH, 6.0), 1.0)).azimuth == AZIMUTH  # behind the camera


@pytest.mark.parametrize("distance", [2.2, 3.0], ids=["in between", "round the camera"])
def test_the_camera_moves_to_the_nearest_side_that_is_free(distance):
    turned = looked_at((*toward(AZIMUTH, distance), 0.4)).azimuth - AZIMUTH
    assert abs(turned) == SIDES_APART
