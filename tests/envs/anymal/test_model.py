"""The quadruped's model: masses and lengths as published, kinematics by hand, frames against SciPy."""

import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cuelearner_envs.anymal import model as robot

LEGS = {"LF": (1, 1), "RF": (1, -1), "LH": (-1, 1), "RH": (-1, -1)}  # front or hind, left or right


@pytest.fixture(scope="module")
def model():
    return robot.load()


def placed(model, joints, qpos=(0, 0, 1, 1, 0, 0, 0)):
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:] = qpos, joints
    mujoco.mj_forward(model, data)
    return data


def test_it_weighs_50_kg_and_each_leg_what_is_published(model):
    assert model.body_mass.sum() == pytest.approx(50.0, abs=1e-6)
    for leg in LEGS:
        masses = [float(model.body(f"{leg}_{part}").mass[0]) for part in ("HIP", "THIGH", "SHANK")]
        np.testing.assert_allclose(masses, [2.781, 3.071, 0.588], atol=1e-3)


@pytest.mark.parametrize("leg", LEGS)
def test_with_straight_legs_the_feet_are_where_the_lengths_add_up_to(model, leg):
    front, left = LEGS[leg]
    foot = placed(model, np.zeros(12)).geom(f"{leg}_FOOT").xpos - [0, 0, 1]
    # Hip, then thigh's offset, knee and foot: 0.300 + 0.060 + 0.088; 0.104 + 0.084 + 0.100 + 0.013; 0.285 + 0.315.
    np.testing.assert_allclose(foot, [front * 0.448, left * 0.301, -0.6], atol=1e-9)


def test_only_feet_touch_and_only_the_floor(model):
    sunk = placed(model, np.zeros(12), (0, 0, 0.0, 1, 0, 0, 0))  # the trunk in the floor, the legs below it
    touching = {tuple(sorted(model.geom(int(geom)).name for geom in contact.geom)) for contact in sunk.contact}
    assert touching == {tuple(sorted((f"{leg}_FOOT", "floor"))) for leg in LEGS}


def test_drives_follow_their_targets_and_give_80_newton_metres_at_most(model):
    data = placed(model, robot.HOME)
    data.qvel[6:] = 0.3
    data.ctrl[:] = robot.HOME + 0.1
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, 100 * 0.1 - 2 * 0.3, atol=1e-9)
    data.ctrl[:] = robot.HOME + 3.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, 80.0)


def test_payload_and_friction_are_those_asked_for():
    model = robot.load(friction=0.5, payload=6.0)
    assert model.body_mass.sum() == pytest.approx(56.0)
    assert model.geom_friction[model.geom("LF_FOOT").id, 0] == 0.5
    data = placed(model, robot.HOME, (0, 0, 0.54, 1, 0, 0, 0))
    assert all(contact.friction[0] == 0.5 for contact in data.contact)
    assert len(data.contact) == 4


def test_frames_are_those_of_scipy():
    rng = np.random.default_rng(0)
    for turn in Rotation.random(20, random_state=1):
        x, y, z, w = turn.as_quat()
        quaternion, vector = jnp.array([w, x, y, z]), rng.normal(size=3)
        matrix = robot.rotation(quaternion)
        np.testing.assert_allclose(matrix, turn.as_matrix(), atol=1e-6)
        np.testing.assert_allclose(robot.in_body(matrix, jnp.asarray(vector)), turn.inv().apply(vector), atol=1e-5)


def test_planar_velocity_is_level_whatever_the_tilt():
    yaw, tilt = 0.7, 0.2
    x, y, z, w = (Rotation.from_euler("z", yaw) * Rotation.from_euler("y", tilt)).as_quat()
    qpos = jnp.concatenate([jnp.array([1.0, 2.0, 0.5, w, x, y, z]), jnp.zeros(12)])
    ahead = np.array([math.cos(yaw), math.sin(yaw), 0.3])  # forward at 1 m/s, and upward
    spin = Rotation.from_euler("y", tilt).inv().apply([0, 0, 0.5])  # about the vertical, in the trunk's frame
    qvel = jnp.concatenate([jnp.asarray(ahead), jnp.asarray(spin), jnp.zeros(12)])
    np.testing.assert_allclose(jax.jit(robot.planar_velocity)(qpos, qvel), [1.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(robot.planar_pose(qpos), [1.0, 2.0, yaw], atol=1e-6)
