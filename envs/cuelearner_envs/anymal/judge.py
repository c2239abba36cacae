"""Simulate many quadrupeds in C MuJoCo with a finer step and a converged solver: an independent check of MJX."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.physics import LEAST_UPRIGHT, LOWEST_KNEE, LOWEST_TRUNK
from cuelearner_envs.judging import in_threads

TIMESTEP = 0.002  # [s]


class Judge:
    """Robots side by side. Each has a model of its own, for friction and payload."""

    def __init__(self, friction: Sequence[float], payload: Sequence[float], timestep: float = TIMESTEP):
        """Make a robot for each entry of `friction` and `payload`, standing at the origin."""
        pairs = list(zip(friction, payload, strict=True))
        self.models = [robot.load(timestep, float(mu), float(mass)) for mu, mass in pairs]
        self.data = [mujoco.MjData(model) for model in self.models]
        self.knees = [self.models[0].body(f"{leg}_SHANK").id for leg in ("LF", "RF", "LH", "RH")]
        self.trunk = self.models[0].body("trunk").id
        self.steps = round(robot.CONTROL_PERIOD / timestep)
        self.down = np.zeros(len(pairs), bool)  # whether each robot has fallen since it was placed
        self.retired = np.zeros(len(pairs), bool)  # whether each robot is no longer simulated
        for number in range(len(pairs)):
            self.place(number, np.zeros(3))

    @property
    def qpos(self) -> Float[np.ndarray, "robots 19"]:
        """Configurations, see `model`."""
        return np.stack([data.qpos for data in self.data]).astype(np.float32)

    @property
    def qvel(self) -> Float[np.ndarray, "robots 18"]:
        """Velocities, see `model`."""
        return np.stack([data.qvel for data in self.data]).astype(np.float32)

    @property
    def fallen(self) -> Bool[np.ndarray, " robots"]:
        """Whether each robot has fallen (as `physics.fallen` says) since it was placed."""
        return self.down

    def place(self, number: int, pose: Float[np.ndarray, "3"]) -> None:
        """Stand a robot at a pose [m, rad], its joints at home."""
        data = self.data[number]
        mujoco.mj_resetDataKeyframe(self.models[number], data, 0)
        data.qpos[:2] = pose[:2]
        data.qpos[3:7] = np.cos(pose[2] / 2), 0, 0, np.sin(pose[2] / 2)
        mujoco.mj_forward(self.models[number], data)
        self.down[number] = False

    def push(self, number: int, change: Float[np.ndarray, "2"]) -> None:
        """Change the trunk's velocity at once [m/s]."""
        self.data[number].qvel[:2] += change

    def control(self, actions: Float[np.ndarray, "robots 12"]) -> None:
        """Apply one control step (0.02 s), with an action in [-1, 1], to each robot not fallen or retired."""
        targets = robot.HOME + robot.ACTION_SCALE * np.asarray(actions, float)
        up = np.flatnonzero(~(self.down | self.retired))
        in_threads(partial(self._control, targets), up)

    def _control(self, targets: Float[np.ndarray, "robots 12"], number: int | np.integer) -> None:
        model, data = self.models[number], self.data[number]
        data.ctrl[:] = targets[number]
        mujoco.mj_step(model, data, nstep=self.steps)
        upright = data.xmat[self.trunk, 8] > LEAST_UPRIGHT and data.qpos[2] > LOWEST_TRUNK
        # MuJoCo sets a robot whose numbers blew up back to its start, and counts the warning.
        blown = any(data.warning[kind].number for kind in _BLOWN)
        self.down[number] = blown or not (upright and (data.xpos[self.knees, 2] > LOWEST_KNEE).all())


_BLOWN = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
