"""Episodes of the arm in C MuJoCo, with equal starts and policies, finer steps and a converged solver."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Key

from cuelearner_envs import judging
from cuelearner_envs.arm import model as arm
from cuelearner_envs.arm.environment import Arm
from cuelearner_envs.arm.physics import ArmState
from cuelearner_jax.types import Policy

TIMESTEP, ITERATIONS = 0.002, 100  # [s]; of the solver


class MujocoArm:
    """Grippers side by side in one world."""

    def __init__(self, env: Arm, count: int, timestep: float = TIMESTEP, iterations: int | None = ITERATIONS) -> None:
        """Make `count` of them; `iterations`: of the solver, as `model.load` has them."""
        self.model = arm.load(env.has_object, timestep, iterations)
        if env.has_object:
            self.model.pair_friction[:, :2] = float(env.ground.friction)
            self.model.geom("post").pos[2] -= 0.0 if float(env.ground.post) > 0 else 1.0
        self.data = [mujoco.MjData(self.model) for _ in range(count)]
        self.steps = round(arm.CONTROL_PERIOD / timestep)

    def place(self, body: ArmState) -> None:
        """Put each of them into a configuration, leaves (count, ...)."""
        for data, qpos, qvel in zip(self.data, np.asarray(body.qpos), np.asarray(body.qvel), strict=True):
            mujoco.mj_resetData(self.model, data)
            data.qpos[:], data.qvel[:] = qpos, qvel
            mujoco.mj_forward(self.model, data)

    def control(self, targets: np.ndarray) -> ArmState:
        """Step control (0.04 s) of each with targets (count, drives); return where that led."""

        def one(number: int) -> None:
            self.data[number].ctrl[:] = targets[number]
            mujoco.mj_step(self.model, self.data[number], nstep=self.steps)

        judging.in_threads(one, range(len(self.data)))
        return self.body

    @property
    def body(self) -> ArmState:
        """The grippers' present configurations."""
        rows = [(data.qpos, data.qvel, data.qacc_warmstart) for data in self.data]
        return ArmState(*(jnp.asarray(np.stack(column), jnp.float32) for column in zip(*rows, strict=True)))


_begin = jax.jit(lambda env, keys: jax.vmap(env.reset)(keys))
_targets = jax.jit(lambda env, *rows: jax.vmap(lambda *one: env.command(*one).all(env.has_object))(*rows))


@jax.jit
def _after(env: Arm, states: Any, body: ArmState) -> Any:
    after = jax.vmap(env.after)(states, body)
    return after, jax.vmap(env.observe)(after), jax.vmap(env.ends)(after)


class GripperCourse:
    """Grippers in C MuJoCo, each in an episode of an environment."""

    def __init__(self, env: Arm, keys: Key[Array, " grippers"]) -> None:
        self.env, self.judge = env, MujocoArm(env, len(keys))
        self.state, self.obs = _begin(env, keys)
        self.judge.place(self.state.body)

    def step(self, actions: Array) -> tuple[dict[str, Array], np.ndarray]:
        """Take a step with each gripper; return outcomes and whether time is up, each (grippers,)."""
        body = self.judge.control(np.asarray(_targets(self.env, self.state, actions)))
        self.state, self.obs, (outcome, truncated) = _after(self.env, self.state, body)
        return outcome, np.asarray(truncated)


def rollout(policy: Policy, env: Arm, *how: Any) -> dict[str, np.ndarray]:
    """Roll out first episodes in C MuJoCo; see `judging.rollout`."""
    return judging.rollout(partial(GripperCourse, env), policy, *how)
