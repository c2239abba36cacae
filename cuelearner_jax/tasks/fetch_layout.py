"""What the numbers of Fetch's observations are (gymnasium_robotics): names and units that Gymnasium does not tell.

Source: `generate_mujoco_observations` and `_get_obs` of `gymnasium_robotics/envs/fetch/fetch_env.py`, version 1.4.2.
"""

from __future__ import annotations

from cuelearner_jax.environment import OWN, Quantity

# What a camera tells of the object and the goal is in metres, and shifts with the camera. What the robot measures of
# itself does not.
_GRIPPER = Quantity("gripper position", 3, "m", "x forward, y to the left, z up, of the world", OWN)
_OBJECT = (
    Quantity("object position", 3, "m", "x forward, y to the left, z up, of the world"),
    Quantity("object relative position", 3, "m", "object less gripper"),
)
_FINGERS = Quantity("finger positions", 2, "m", "how far each finger is open", OWN)
_MOTION = (
    Quantity("object rotation", 3, "rad (Euler angles)"),
    Quantity("object velocity", 3, "m a step", "relative to the gripper"),
    Quantity("object angular velocity", 3, "rad a step"),
)
_GRIPPER_MOTION = (
    Quantity("gripper velocity", 3, "m a step"),
    Quantity("finger velocities", 2, "m a step"),
)
_DESIRED = Quantity("desired goal", 3, "m", "where the gripper, or the object, is to be")
CUES = ("forward,backward", "left,right", "up,down", "open,close")
CUE_NAMES = ("x", "y", "z", "fingers")


def layout_of(environment: str) -> tuple[Quantity, ...] | None:
    """Return the slices of one of Fetch's observations, in Gymnasium's order; None for any other environment."""
    if environment.startswith("FetchReach"):
        achieved = Quantity("achieved goal", 3, "m", "the gripper position again", OWN)
        return achieved, _DESIRED, _GRIPPER, _FINGERS, *_GRIPPER_MOTION
    if environment.startswith(("FetchPush", "FetchSlide", "FetchPickAndPlace")):
        achieved = Quantity("achieved goal", 3, "m", "the object position again")
        return achieved, _DESIRED, _GRIPPER, *_OBJECT, _FINGERS, *_MOTION, *_GRIPPER_MOTION
    return None
