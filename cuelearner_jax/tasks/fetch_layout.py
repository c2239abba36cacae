"""Names and units of the numbers in Fetch's observations (gymnasium_robotics), which Gymnasium does not give.

Source: `generate_mujoco_observations` and `_get_obs` of `gymnasium_robotics/envs/fetch/fetch_env.py`, version 1.4.2.
"""

from __future__ import annotations

import json
import math
from typing import Any

from cuelearner_envs.fetch.cues import CUE_NAMES, CUES
from cuelearner_jax.environment import OWN, Quantity

__all__ = ["CUES", "CUE_NAMES", "layout_of", "picture_arguments", "points_of"]

# A camera measures object and goal in metres, shifted with the camera. The robot's measurements of itself are not
# shifted.
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
_GRIPPER_MOTION = (Quantity("gripper velocity", 3, "m a step"), Quantity("finger velocities", 2, "m a step"))
_DESIRED = Quantity("desired goal", 3, "m", "where the gripper, or the object, is to be")
# The camera looks over the robot's shoulder, so that its left is to the left. Fetch's own faces the robot.
CAMERA = {"distance": 1.6, "azimuth": 45.0, "elevation": -30.0, "lookat": [1.3, 0.75, 0.5]}
FETCH = "FetchReach", "FetchPush", "FetchSlide", "FetchPickAndPlace"


def layout_of(environment: str) -> tuple[Quantity, ...] | None:
    """Return the slices of one of Fetch's observations, in Gymnasium's order; None for any other environment."""
    if environment.startswith("FetchReach"):
        achieved = Quantity("achieved goal", 3, "m", "the gripper position again", OWN)
        return achieved, _DESIRED, _GRIPPER, _FINGERS, *_GRIPPER_MOTION
    if environment.startswith(FETCH):
        achieved = Quantity("achieved goal", 3, "m", "the object position again")
        return achieved, _DESIRED, _GRIPPER, *_OBJECT, _FINGERS, *_MOTION, *_GRIPPER_MOTION
    return None


def picture_arguments(environment: str, arguments: str) -> str:
    """Return an environment's arguments (JSON) for pictures: with this camera, where Fetch is given none."""
    options: dict[str, Any] = json.loads(arguments)
    if not environment.startswith(FETCH) or "default_camera_config" in options:
        return arguments
    return json.dumps({**options, "default_camera_config": CAMERA})


def points_of(environment: str, arguments: str) -> tuple[tuple[float, float] | None, ...]:
    """Return the screen direction for "more" of each cue in Fetch's pictures (`Sketch.points`); else empty."""
    if not environment.startswith(FETCH):
        return ()
    up = (0.0, -1.0)
    if "default_camera_config" in json.loads(arguments):
        return None, None, up, None
    turn, tilt = (math.radians(float(CAMERA[name])) for name in ("azimuth", "elevation"))  # pyright: ignore
    sight, rise = (math.cos(turn), math.sin(turn)), math.sin(-tilt)
    # A step away from the camera moves up in the picture, in proportion to the camera's downward tilt.
    forward, left = (sight[1], -sight[0] * rise), (-sight[0], -sight[1] * rise)
    return forward, left, up, None
