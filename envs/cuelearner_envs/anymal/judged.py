"""Navigation episodes of the quadruped in C MuJoCo, with the starts, policies, commands and lidar of MJX."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PRNGKeyArray

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
    def outcomes(self) -> list[str]:
        """Names of an episode's outcomes."""
        first = jax.tree.map(lambda leaf: leaf[0], self.state)
        return list(jax.eval_shape(self.env.ends, first)[0])

    @property
    def poses(self) -> np.ndarray:
        """x, y, yaw [m, rad] of each robot (robots, 3)."""
        return np.asarray(_poses(self.state.body.qpos))

    def step(self, actions: jax.Array, each: Callable[[np.ndarray], None] | None = None) -> tuple[Any, Any, Any]:
        """Take one navigation step with each robot; `each` is called with the configurations after every control step.

        Returns:
            outcome, terminated, truncated, as `Navigation.ends` does, each (robots,).
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
        return jax.device_get(ends)


def rollout(
    policy: Policy,
    env: LeggedNavigation,
    key: PRNGKeyArray,
    num_envs: int,
    steps: int,
    tell: Callable[[int, int], None] = lambda done, count: None,
) -> dict[str, np.ndarray]:
    """`cuelearner_jax.evaluate.rollout` of first episodes alone, the same ones, in C MuJoCo.

    `tell` is told how many steps of how many each robot has made.

    Returns:
        Outcomes of each episode (num_envs,), nan where it has not ended within `steps` shared by all, and "finished".
    """
    k_reset, k_run = jax.random.split(key)
    course = Course(env, jax.random.split(k_reset, num_envs))
    choose = jax.jit(policy.act)
    running = np.ones(num_envs, bool)
    found = {name: np.full(num_envs, np.nan) for name in course.outcomes}
    for index in range(steps // num_envs):
        tell(index, steps // num_envs)
        k_act, _ = jax.random.split(jax.random.fold_in(k_run, index))
        outcome, terminated, truncated = course.step(choose(k_act, course.state, course.obs))
        ended = running & (terminated | truncated)
        for name, values in found.items():
            values[ended] = outcome[name][ended]
        running &= ~ended
        course.judge.retired |= ended
        if not running.any():
            break
    return {**found, "finished": 1.0 - running}
