"""Navigation episodes of the quadruped in C MuJoCo, with the starts, policies, commands and lidar of MJX."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from cuelearner_envs import judging
from cuelearner_envs.anymal.environment import LeggedNavigation, LeggedWalker
from cuelearner_envs.anymal.judge import Judge
from cuelearner_envs.anymal.model import planar_pose
from cuelearner_envs.navigation.environment import latest_first
from cuelearner_jax.spaces.directions import rotate
from cuelearner_jax.types import Policy


@jax.jit
def _begin(env: LeggedNavigation, keys: Key[Array, " robots"]) -> tuple[LeggedWalker, jax.Array]:
    return jax.vmap(env.reset)(keys)


@jax.jit
def _act(
    env: LeggedNavigation, body: Any, last_action: jax.Array, told: jax.Array, headings: jax.Array
) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(env.act)(body, last_action, told, headings)


_poses = jax.jit(jax.vmap(planar_pose))


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0, 0, 0, 0, 0))
def _after(
    env: LeggedNavigation,
    state: LeggedWalker,
    body: Any,
    last: jax.Array,
    told: jax.Array,
    action: jax.Array,
    fallen: jax.Array,
) -> tuple[LeggedWalker, jax.Array, Any]:
    """Return the state after a step of another engine, its observation, and what has ended."""
    after = state.replace(
        body=body,
        last_action=last,
        told=told,
        previous=latest_first(action, state.previous),
        steps=state.steps + 1,
        fallen=state.fallen | fallen,
    )
    after = env.counted(state, after)
    return after, env.observe(after), env.ends(after)


class Course:
    """Robots in C MuJoCo, each in an episode of an environment."""

    def __init__(self, env: LeggedNavigation, keys: Key[Array, " robots"]):
        """Place one robot per key, at the start that `env.reset` gives for its key."""
        self.env = env
        self.state, self.obs = _begin(env, keys)
        count = len(keys)
        self.judge = Judge([float(env.ground.friction)] * count, [float(env.ground.payload)] * count)
        for number, pose in enumerate(self.poses):
            self.judge.place(number, pose)

    @property
    def poses(self) -> np.ndarray:
        """x, y, yaw [m, rad] of each robot (robots, 3)."""
        return np.asarray(_poses(self.state.body.qpos))

    def step(
        self, actions: jax.Array, each: Callable[[np.ndarray], None] | None = None
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Take one navigation step with each robot; return outcomes and whether the episodes ended, each (robots,).

        `each` is called with the configurations after every control step.
        """
        headings = rotate(actions, jnp.asarray(self.poses[:, 2]))
        body, last, told = self.state.body, self.state.last_action, self.state.told
        for _ in range(self.env.control_steps):
            last, told = _act(self.env, body, last, told, headings)
            self.judge.control(np.asarray(last))
            body = body.replace(qpos=jnp.asarray(self.judge.qpos), qvel=jnp.asarray(self.judge.qvel))
            if each:
                each(self.judge.qpos)
        fallen = jnp.asarray(self.judge.fallen)
        self.state, self.obs, ends = _after(self.env, self.state, body, last, told, actions, fallen)
        outcome, terminated, truncated = jax.device_get(ends)
        self.judge.retired |= terminated | truncated
        return outcome, terminated | truncated


def rollout(policy: Policy, env: LeggedNavigation, *how: Any) -> dict[str, np.ndarray]:
    """Roll out first episodes in C MuJoCo; see `judging.rollout`."""
    return judging.rollout(partial(Course, env), policy, *how)
