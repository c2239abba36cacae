"""An arm whose camera was moved: the policy, and a person's idea of the right motion. See the README.

    cuelearner label gymnasium:FetchReach-v4 examples.moved_camera:moved --out labels/reach

FetchReach's goal is seen 8 cm too far left, so the arm stops beside every goal. `reach` sees the true goal.
"""

from __future__ import annotations

import numpy as np

OFFSET = 0.08  # by which the goal is seen too far left [m]


def reach(obs: np.ndarray) -> np.ndarray:
    """Return the motions (n, 4) that lead the gripper straight to the goal, for observations (n, 16)."""
    motion = np.clip(10 * (obs[:, 3:6] - obs[:, 6:9]), -1, 1)  # goal less gripper [m]; 1 is a whole step
    return np.pad(motion, ((0, 0), (0, 1)))  # the fingers stay as they are


def moved(obs: np.ndarray) -> np.ndarray:
    """Return the motions (n, 4) of the same policy behind the camera that was moved."""
    return reach(obs + OFFSET * (np.arange(16) == 4))
