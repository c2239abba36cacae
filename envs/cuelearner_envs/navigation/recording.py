"""Walking step after step and keeping what a picture needs."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, PRNGKeyArray

from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.world import NavigationWorld
from cuelearner_envs.playing import record_steps
from cuelearner_jax.types import Policy, Step

ENDS = ("success", "collision", "fall", "timeout")


class RecordedStep(NamedTuple):
    """One step of an episode, in NumPy arrays."""

    world: NavigationWorld  # the one walked in, no batch
    goal: Float[np.ndarray, "2"]  # [m]
    goal_radius: float | np.ndarray  # nearer than this, the goal is reached [m]
    pose: Float[np.ndarray, "3"]  # before the step: x, y, yaw [m, rad]
    ranges: Float[np.ndarray, "271"]  # what the lidar perceives there [m]
    max_range: float | np.ndarray  # what a beam reads that meets nothing [m]
    action: Float[np.ndarray, "2"]  # direction chosen there, unit vector in the body's frame
    next_pose: Float[np.ndarray, "3"]  # where the step led, before any reset [m, rad]
    seconds: float | np.ndarray  # since the episode began, at the end of the step [s]
    outcome: str = ""  # one of `ENDS` if the episode ended with this step, otherwise empty
    episode: int = 0  # counted from 0


@jax.jit
def _view(env: Navigation, state: Any, after: Any) -> dict[str, Any]:
    world, radius, most = env.world(state.world), jnp.asarray(env.goal_radius), jnp.asarray(env.lidar.max_range)
    view = {"world": world, "goal": state.goal, "goal_radius": radius, "pose": state.pose, "ranges": env.ranges(state)}
    seconds = after.steps * jnp.asarray(env.period)
    return {**view, "max_range": most, "next_pose": after.pose, "seconds": seconds}


def situation(env: Navigation, state: Any, action: Float[ArrayLike, "2"]) -> RecordedStep:
    """Return a state's frame for a picture, with the asked action."""
    return RecordedStep(**jax.device_get(_view(env, state, state)), action=np.asarray(action))


def record(env: Navigation, policy: Policy, key: PRNGKeyArray, steps: int) -> tuple[list[RecordedStep], list[float]]:
    """Frames and rewards of `steps` steps of a policy; a new episode follows the end of one."""

    def see(env: Navigation, state: Any, action: jax.Array, step: Step) -> tuple[Any, ...]:
        ends = jnp.stack([step.outcome.get(name, jnp.zeros(())) for name in ENDS])  # only legged robots fall
        return {**_view(env, state, env.move(state, action)), "action": action}, ends, step.reward

    frames, episode, rows = [], 0, record_steps(env, policy, key, steps, see)
    for view, ends, _ in rows:
        outcome = "".join(name for name, ended in zip(ENDS, ends, strict=True) if ended)
        frames.append(RecordedStep(**view, outcome=outcome, episode=episode))
        episode += bool(outcome)
    return frames, [float(reward) for *_, reward in rows]
