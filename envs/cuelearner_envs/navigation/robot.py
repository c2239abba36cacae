"""The simple robot: a model of the quadruped's motion, and the room that its body takes.

A stand-in for a legged robot with its walking controller, which MuJoCo simulates elsewhere. ANYmal's body (0.93 m by
0.53 m) is three discs along its axis. Its velocity follows the command with a first-order lag, and the body turns
toward the commanded direction at a bounded rate. Everything is solved in closed form over a control step.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from cuelearner_envs.navigation.geometry import clearance
from cuelearner_envs.navigation.world import NavigationWorld
from cuelearner_jax.spaces.directions import from_angle, rotate, to_angle

Scalar = float | Float[Array, ""]


class Robot(struct.PyTreeNode):
    """Parameters of the motion, all of them traced."""

    speed: Scalar = 1.0  # at which it is told to walk [m/s]
    lag: Scalar = 0.1  # time constant of its velocity [s]
    turn_rate: Scalar = 1.5  # largest [rad/s]
    disc_radius: Scalar = 0.265  # [m]
    disc_offset: Scalar = 0.2  # of the front and rear discs from the centre, along the body [m]

    @property
    def reach(self) -> Scalar:
        """Distance from the centre to the body's farthest point [m]: clear of this, it may turn as it likes."""
        return self.disc_radius + self.disc_offset


def hull(robot: Robot) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "3 2"]]:
    """Return the outline of the body, which its three discs span, and a chevron that points ahead [m]."""
    radius, offset = float(robot.disc_radius), float(robot.disc_offset)
    bend = np.linspace(-np.pi / 2, np.pi / 2, 13)
    front = np.stack([np.cos(bend), np.sin(bend)], axis=-1) * radius + [offset, 0.0]
    tip = offset + 0.6 * radius
    back = tip - 1.1 * radius
    return np.concatenate([front, -front]), np.array([[tip, 0.0], [back, 0.6 * radius], [back, -0.6 * radius]])


def walk(
    robot: Robot, pose: Float[Array, "3"], velocity: Float[Array, "2"], direction: Float[Array, "2"], duration: Scalar
) -> tuple[Float[Array, "3"], Float[Array, "2"]]:
    """Return pose and velocity after `duration` [s] of the command to walk in `direction`, in the body's frame.

    Poses are x, y, yaw [m, rad]; velocities are in the world's frame [m/s]. There the command is held meanwhile: the
    body turns under it.
    """
    position, yaw = pose[:2], pose[2]
    target = robot.speed * rotate(direction, yaw)
    fading = jnp.exp(-duration / robot.lag)
    off = velocity - target
    position = position + target * duration + off * robot.lag * (1.0 - fading)
    limit = robot.turn_rate * duration
    turned = yaw + jnp.clip(to_angle(direction), -limit, limit)
    return jnp.concatenate([position, to_angle(from_angle(turned))[None]]), target + off * fading


def collides(robot: Robot, world: NavigationWorld, pose: Float[Array, "3"]) -> Bool[Array, ""]:
    """Whether the body touches a solid, or stands outside the walls."""
    along = jnp.array([-1.0, 0.0, 1.0]) * robot.disc_offset  # of the rear, the middle and the front disc
    centres = pose[None, :2] + along[:, None] * from_angle(pose[2])[None]
    touching = jax.vmap(lambda centre: clearance(world, centre))(centres) < robot.disc_radius
    return touching.any() | (jnp.abs(pose[:2]) > world.extent / 2).any()
