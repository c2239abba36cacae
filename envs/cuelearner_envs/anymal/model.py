"""The quadruped's model and the frames of its body, for MuJoCo and for MJX.

A body's configuration is MuJoCo's. `qpos` (19,) is the trunk's place [m], its quaternion (w, x, y, z) and the joints
[rad]. `qvel` (18,) is the trunk's velocity in the world's frame [m/s], its angular velocity in its own frame [rad/s]
and the joints' [rad/s]. Joints go by leg (left front, right front, left hind, right hind), each hip abduction, hip
flexion, knee flexion.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

FILE = Path(__file__).parent / "anymal.xml"
JOINTS = 12
LEGS = ("LF", "RF", "LH", "RH")  # left or right, front or hind
FRICTION = 0.8  # of feet on the floor, unless changed
CONTROL_PERIOD = 0.02  # [s]: the policy acts at 50 Hz
FOOT_RADIUS = 0.03  # [m]
ACTION_SCALE = np.tile([0.5, 0.8, 0.8], 4)  # how far an action of 1 moves a joint's target from home [rad]
HOME = np.array([0, 0.4, -0.8, 0, 0.4, -0.8, 0, -0.4, 0.8, 0, -0.4, 0.8])  # targets of the standing robot [rad]
STANDING_HEIGHT = 0.55  # of the trunk's middle, the legs at home, feet just above the floor [m]


def load(timestep: float | None = None, friction: float = FRICTION, payload: float = 0.0) -> mujoco.MjModel:
    """Load the model, with a payload carried at the trunk's centre of mass [kg].

    `timestep`: of the physics [s], 0.01 s unless given. With one, the solver runs to convergence, as a judge of MJX.
    """
    model = mujoco.MjModel.from_xml_path(str(FILE))
    if timestep is not None:
        model.opt.timestep, model.opt.iterations, model.opt.ls_iterations = timestep, 100, 50
    feet = [model.geom(f"{leg}_FOOT").id for leg in LEGS]
    model.geom_friction[feet, 0] = friction
    model.body("trunk").mass[:] += payload
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def rotation(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Return the matrix that rotates the body's frame into the world's."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def in_body(turn: Float[Array, "3 3"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rotate a vector from the world's frame into the body's."""
    # A sum, since accelerators round the factors of a matrix product.
    return jnp.sum(turn * vector[:, None], axis=0)


def planar_pose(qpos: Float[Array, "19"]) -> Float[Array, "3"]:
    """x, y and yaw of the trunk [m, rad]."""
    w, x, y, z = qpos[3:7]
    return jnp.stack([qpos[0], qpos[1], jnp.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))])


def planar_velocity(qpos: Float[Array, "19"], qvel: Float[Array, "18"]) -> Float[Array, "3"]:
    """Forward and sideways velocity [m/s] in the frame that is turned by the yaw alone, and turning rate [rad/s].

    This is what a velocity command speaks of: the floor's plane, whatever the trunk's tilt.
    """
    yaw = planar_pose(qpos)[2]
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    turning = jnp.sum(rotation(qpos[3:7])[2] * qvel[3:6])
    return jnp.stack([cos * qvel[0] + sin * qvel[1], cos * qvel[1] - sin * qvel[0], turning])
