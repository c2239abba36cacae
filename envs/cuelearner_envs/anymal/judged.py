"""The quadruped in C MuJoCo, with a finer step and a converged solver: an independent check of MJX.

`rollout` plays navigation episodes with the starts, policies, commands and lidar of MJX.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from cuelearner_envs import judging
from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.environment import CONTROL_STEPS, LeggedNavigation, LeggedWalker
from cuelearner_envs.anymal.physics import LEAST_UPRIGHT, LOWEST_KNEE, LOWEST_TRUNK
from cuelearner_envs.navigation.environment import latest_first
from cuelearner_jax.spaces.directions import rotate
from cuelearner_jax.types import Policy

TIMESTEP = 0.002  # [s]
DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


class MujocoAnymal:
    """Robots side by side. Each has a model of its own, for friction and payload."""

    def __init__(self, friction: Sequence[float], payload: Sequence[float]):
        """Make a robot for each entry of `friction` and `payload`, standing at the origin."""
        pairs = zip(friction, payload, strict=True)
        self.models = [robot.load(TIMESTEP, float(mu), float(mass)) for mu, mass in pairs]
        self.data = [mujoco.MjData(model) for model in self.models]
        self.knees = [self.models[0].body(f"{leg}_SHANK").id for leg in robot.LEGS]
        self.trunk = self.models[0].body("trunk").id
        self.fallen = np.zeros(len(self.models), bool)  # (as `physics.fallen` says) since each robot was placed
        self.retired = np.zeros(len(self.models), bool)  # whether each robot is no longer simulated
        for number in range(len(self.models)):
            self.place(number, np.zeros(3))

    @property
    def qpos(self) -> Float[np.ndarray, "robots 19"]:
        """Configurations, see `model`."""
        return np.stack([data.qpos for data in self.data]).astype(np.float32)

    @property
    def qvel(self) -> Float[np.ndarray, "robots 18"]:
        """Velocities, see `model`."""
        return np.stack([data.qvel for data in self.data]).astype(np.float32)

    def place(self, number: int, pose: Float[np.ndarray, "3"]) -> None:
        """Stand a robot at a pose [m, rad], its joints at home."""
        data = self.data[number]
        mujoco.mj_resetDataKeyframe(self.models[number], data, 0)
        data.qpos[:2] = pose[:2]
        data.qpos[3:7] = np.cos(pose[2] / 2), 0, 0, np.sin(pose[2] / 2)
        mujoco.mj_forward(self.models[number], data)
        self.fallen[number] = False

    def push(self, number: int, change: Float[np.ndarray, "2"]) -> None:
        """Change the trunk's velocity at once [m/s]."""
        self.data[number].qvel[:2] += change

    def control(self, actions: Float[np.ndarray, "robots 12"]) -> None:
        """Apply one control step (0.02 s), with an action in [-1, 1], to each robot not fallen or retired."""
        targets = robot.HOME + robot.ACTION_SCALE * np.asarray(actions, float)

        def one(number: int | np.integer) -> None:
            data = self.data[number]
            data.ctrl[:] = targets[number]
            mujoco.mj_step(self.models[number], data, nstep=round(robot.CONTROL_PERIOD / TIMESTEP))
            upright = data.xmat[self.trunk, 8] > LEAST_UPRIGHT and data.qpos[2] > LOWEST_TRUNK
            # MuJoCo sets a robot whose numbers diverged back to its start, and counts the warning.
            diverged = any(data.warning[kind].number for kind in DIVERGED)
            self.fallen[number] = diverged or not (upright and (data.xpos[self.knees, 2] > LOWEST_KNEE).all())

        judging.in_threads(one, np.flatnonzero(~(self.fallen | self.retired)))


_begin = jax.jit(lambda env, keys: jax.vmap(env.reset)(keys))
_act = jax.jit(lambda env, *parts: jax.vmap(env.act)(*parts))
_poses = jax.jit(jax.vmap(robot.planar_pose))


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0, 0))
def _after(
    env: LeggedNavigation, state: LeggedWalker, action: Array, changes: dict[str, Any]
) -> tuple[LeggedWalker, Array, Any]:
    """Return the state after a step of another engine, its observation, and what has ended."""
    previous, fallen = latest_first(action, state.previous), state.fallen | changes["fallen"]
    after = state.replace(**{**changes, "fallen": fallen}, previous=previous, steps=state.steps + 1)
    after = env.counted(state, after)
    return after, env.observe(after), env.ends(after)


class Course:
    """Robots in C MuJoCo, each in an episode of an environment."""

    def __init__(self, env: LeggedNavigation, keys: Key[Array, " robots"]):
        """Place one robot per key, at the start that `env.reset` gives for its key."""
        self.env = env
        self.state, self.obs = _begin(env, keys)
        self.judge = MujocoAnymal([float(env.ground.friction)] * len(keys), [float(env.ground.payload)] * len(keys))
        for number, pose in enumerate(np.asarray(_poses(self.state.body.qpos))):
            self.judge.place(number, pose)

    def step(
        self, actions: Array, each: Callable[[np.ndarray], None] | None = None
    ) -> tuple[dict[str, np.ndarray], Bool[np.ndarray, " robots"]]:
        """Take one navigation step with each robot; return outcomes and whether the episodes ended, each (robots,).

        `each` is called with the configurations after every control step.
        """
        body, last, command = self.state.body, self.state.last_action, self.state.command
        headings = rotate(actions, jnp.asarray(_poses(body.qpos))[:, 2])
        for _ in range(CONTROL_STEPS):
            last, command = _act(self.env, body, last, command, headings)
            self.judge.control(np.asarray(last))
            body = body.replace(qpos=jnp.asarray(self.judge.qpos), qvel=jnp.asarray(self.judge.qvel))
            if each:
                each(self.judge.qpos)
        changes = {"body": body, "last_action": last, "command": command, "fallen": jnp.asarray(self.judge.fallen)}
        self.state, self.obs, ends = _after(self.env, self.state, actions, changes)
        outcome, terminated, truncated = jax.device_get(ends)
        self.judge.retired |= terminated | truncated
        return outcome, terminated | truncated


def rollout(policy: Policy, env: LeggedNavigation, *how: Any) -> dict[str, np.ndarray]:
    """Roll out first episodes in C MuJoCo; see `judging.rollout`."""
    return judging.rollout(partial(Course, env), policy, *how)
