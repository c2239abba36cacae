"""The quadruped's episodes in C MuJoCo, kept step by step, and their pictures: a still, and a film of two views."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v2 as imageio
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.environment import LeggedNavigation
from cuelearner_envs.anymal.judged import Course
from cuelearner_envs.anymal.scene import AZIMUTH, Picture, Studio, above, furnish, unobstructed
from cuelearner_envs.navigation.lidar import BEAM_ANGLES
from cuelearner_envs.navigation.recording import ENDS
from cuelearner_envs.navigation.world import NavigationWorld
from cuelearner_jax import pictures
from cuelearner_jax.types import Policy

VIEW = (400, 400)  # width and height of each view [dots]; a film shows two side by side
STILL = (960, 540)
HOLD = 1.0  # at the end of an episode [s]
COLOURS = 200  # of a GIF


class LeggedFrame(NamedTuple):
    """One navigation step, in NumPy arrays."""

    world: NavigationWorld  # the one walked in, no batch
    goal: Float[np.ndarray, "2"]  # [m]
    goal_radius: float  # nearer than this, the goal is reached [m]
    ends: Float[np.ndarray, "271 3"]  # where the beams end that were perceived at the step's beginning [m]
    hits: Bool[np.ndarray, " 271"]  # which of them end at something
    qpos: Float[np.ndarray, "control 19"]  # after each step of control, see `model`
    outcome: str  # one of `ENDS` if the episode ended with this step, otherwise empty
    episode: int  # counted from 0


def record(
    env: LeggedNavigation, policy: Policy, key: PRNGKeyArray, steps: int
) -> tuple[list[LeggedFrame], list[float]]:
    """Frames and rewards of `steps` steps of a policy in C MuJoCo; a new episode follows the end of one."""
    choose, see = jax.jit(policy.act), jax.jit(_perceived)
    frames, rewards, course, episode = [], [], None, -1
    for number in range(steps):
        if course is None:
            episode += 1
            course = Course(env, jax.random.fold_in(key, episode)[None])
        state = jax.tree.map(lambda leaf: leaf[0], course.state)
        ends, hits, world = jax.device_get(see(env, state))
        configurations: list[np.ndarray] = []
        action = choose(jax.random.fold_in(key, number), course.state, course.obs)
        outcome, ended = course.step(action, each=lambda qpos, rows=configurations: rows.append(qpos[0]))
        names = [name for name in ENDS if outcome.get(name, np.zeros(1))[0]]
        rewards.append(10.0 if "success" in names else 0.0 if names in ([], ["timeout"]) else -10.0)
        frames.append(
            LeggedFrame(
                world=world,
                goal=np.asarray(state.goal),
                goal_radius=float(env.goal_radius),
                ends=ends,
                hits=hits,
                qpos=np.stack(configurations),
                outcome="".join(names),
                episode=episode,
            )
        )
        if ended[0]:
            course = None
    return frames, rewards


def still(frames: Sequence[LeggedFrame], file: str | os.PathLike[str]) -> None:
    """The robot in its world at the last frame, from the side, with what its lidar perceives."""
    frame = frames[-1]
    with Studio(furnish(frame.world, frame.goal, frame.goal_radius), *STILL) as studio:
        studio.pose(frame.qpos[0])
        camera = unobstructed(studio.model, studio.data, distance=4.5)
        imageio.imwrite(Path(file), studio.picture(camera, frame.ends, frame.hits))


def animate(frames: Sequence[LeggedFrame], file: str | os.PathLike[str]) -> None:
    """A film in real time: the hall from above on the left, the robot from the side on the right."""
    fps = 10.0 if str(file).endswith(".gif") else 25.0
    specimen = next(_pictures(frames[:1], fps))
    pictures.write_film(file, fps, partial(_pictures, frames), pictures.palette_of(specimen, COLOURS))


def _perceived(env: LeggedNavigation, state: Any) -> tuple[jax.Array, jax.Array, NavigationWorld]:
    """Return the perceived ends of the lidar's beams (beams, 3) [m], which beams hit something, and the world."""
    turn = robot.rotation(state.body.qpos[3:7])
    angles = BEAM_ANGLES + jnp.asarray(env.lidar.rotation)
    ahead = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    beams = ahead[:, :1] * turn[:, 0] + ahead[:, 1:] * turn[:, 1]
    ranges = env.ranges(state)
    hits = ranges < 0.999 * jnp.asarray(env.lidar.max_range)
    return state.body.qpos[:3] + ranges[:, None] * beams, hits, env.world(state.world)


def _pictures(frames: Sequence[LeggedFrame], fps: float) -> Iterator[Picture]:
    """Both views side by side, `fps` a second, and the end of each episode for a while."""
    stride = max(1, round(1.0 / fps / robot.CONTROL_PERIOD))
    for _, group in itertools.groupby(frames, key=lambda frame: frame.episode):
        episode = list(group)
        first = episode[0]
        with Studio(furnish(first.world, first.goal, first.goal_radius), *VIEW) as studio:
            high, near, picture = above(np.asarray(first.world.extent)), AZIMUTH, None
            moments = [(frame, qpos) for frame in episode for qpos in frame.qpos]
            for frame, qpos in moments[::stride]:
                studio.pose(qpos)
                side = unobstructed(studio.model, studio.data, near)
                near = side.azimuth  # it stays there until something comes in between
                views = [studio.picture(camera, frame.ends, frame.hits) for camera in (high, side)]
                picture = np.concatenate(views, axis=1)
                yield picture
            if episode[-1].outcome and picture is not None:
                yield from itertools.repeat(picture, round(HOLD * fps))
