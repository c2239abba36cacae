"""Walking step after step and keeping what a picture needs."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, PRNGKeyArray

from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.world import World
from cuelearner_envs.playing import played
from cuelearner_jax.types import Policy, Step

ENDS = ("success", "collision", "fall", "timeout")


class Frame(NamedTuple):
    """One step of an episode, in NumPy arrays."""

    world: World  # the one walked in, no batch
    goal: Float[np.ndarray, "2"]  # [m]
    goal_radius: float  # nearer than this, the goal is reached [m]
    pose: Float[np.ndarray, "3"]  # before the step: x, y, yaw [m, rad]
    ranges: Float[np.ndarray, "271"]  # what the lidar perceives there [m]
    max_range: float  # what a beam reads that meets nothing [m]
    action: Float[np.ndarray, "2"]  # direction chosen there, unit vector in the body's frame
    next_pose: Float[np.ndarray, "3"]  # where the step led, before any reset [m, rad]
    seconds: float  # since the episode began, at the end of the step [s]
    outcome: str  # one of `ENDS` if the episode ended with this step, otherwise empty
    episode: int  # counted from 0


def situation(env: Navigation, state: Any, action: Float[ArrayLike, "2"]) -> Frame:
    """Return a state's frame for a picture, with the asked action."""
    seen = jax.device_get(_seen(env, state))
    return Frame(
        world=seen["world"],
        goal=seen["goal"],
        goal_radius=float(env.goal_radius),
        pose=seen["pose"],
        ranges=seen["ranges"],
        max_range=float(env.lidar.max_range),
        action=np.asarray(action),
        next_pose=seen["pose"],
        seconds=float(seen["seconds"]),
        outcome="",
        episode=0,
    )


@jax.jit
def _seen(env: Navigation, state: Any) -> dict[str, Any]:
    return {
        "world": env.world(state.world),
        "goal": state.goal,
        "pose": state.pose,
        "ranges": env.ranges(state),
        "seconds": state.steps * jnp.asarray(env.period),
    }


def record(env: Navigation, policy: Policy, key: PRNGKeyArray, steps: int) -> tuple[list[Frame], list[float]]:
    """Frames and rewards of `steps` steps of a policy; a new episode follows the end of one."""

    def see(env: Navigation, state: Any, action: jax.Array, step: Step) -> tuple[jax.Array, ...]:
        moved = env.moved(state, action)
        ends = jnp.stack([step.outcome.get(name, jnp.zeros(())) for name in ENDS])  # only legged robots fall
        seen = (state.world, state.goal, state.pose, env.ranges(state))
        return (*seen, action, moved.pose, moved.steps * jnp.asarray(env.period), ends, step.reward)

    found = played(env, policy, key, steps, see)
    which, goals, poses, ranges, actions, next_poses, seconds, ends, rewards = found
    worlds = jax.device_get(env.world(which))
    finished = np.cumsum(ends.any(-1))
    frames = [
        Frame(
            world=jax.tree.map(lambda leaf, number=number: leaf[number], worlds),
            goal=goals[number],
            goal_radius=float(env.goal_radius),
            pose=poses[number],
            ranges=ranges[number],
            max_range=float(env.lidar.max_range),
            action=actions[number],
            next_pose=next_poses[number],
            seconds=float(seconds[number]),
            outcome="".join(name for name, ended in zip(ENDS, ends[number], strict=True) if ended),
            episode=int(finished[number - 1]) if number else 0,
        )
        for number in range(steps)
    ]
    return frames, [float(reward) for reward in rewards]
