"""Pictures of brax's and Playground's environments, drawn from their models by MuJoCo's renderer."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no stubs)

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from cuelearner_envs.anymal.scene import Studio
from cuelearner_jax import pictures, user_code
from cuelearner_jax.bridges.jax_environment import JaxEnvironment, Running, model_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.task import Pictures
from cuelearner_jax.types import Reel, Sketch

SIZE = (480, 360)  # width and height [pixels]
HELD = 5  # steps for which a clip holds an action, since one step is hardly visible
PERIOD = 0.1  # time between two frames of a clip [s]
FPS = 25.0  # of a film, one frame per step

Frame = UInt8[np.ndarray, "height width 3"]


class Pose(NamedTuple):
    """Positions of a model's bodies."""

    qpos: Float[Array, "*steps qpos"]
    mocap: Float[Array, "*steps bodies 3"] | None  # positions of bodies without joints; None: the simulator has none


def pose_of(state: Running) -> Pose:
    """Return the positions of a state's bodies. Raises UserError for a simulator unlike MuJoCo's."""
    inner = state.state
    if hasattr(inner, "data"):
        return Pose(inner.data.qpos, inner.data.mocap_pos)
    physics: Any = getattr(inner, "pipeline_state", None)
    if not hasattr(physics, "q"):
        raise UserError("this simulator has no bodies to draw: evaluate a policy in it instead")
    return Pose(physics.q, None)


def draw_poses(env: JaxEnvironment, poses: Sequence[Pose]) -> list[Frame]:
    """Return a picture of each pose. Raises UserError for an environment without a MuJoCo model, or without OpenGL."""
    model = model_of(env.simulator())
    if model is None:
        raise UserError("this environment has no MuJoCo model to draw: evaluate a policy in it instead")
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    if model.ncam:
        camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    frames = []
    with Studio(model, *SIZE) as studio:
        for pose in poses:
            if pose.mocap is not None and model.nmocap:
                studio.data.mocap_pos[:] = pose.mocap
            studio.pose(np.asarray(pose.qpos))
            frames.append(np.ascontiguousarray(studio.picture(camera)))
    return frames


def picture(env: JaxEnvironment, state: Running) -> Frame:
    """Return a picture of a state. Raises UserError as `draw_poses`."""
    return draw_poses(env, [jax.device_get(pose_of(state))])[0]


def sketch(env: JaxEnvironment, state: Running) -> Sketch:
    """Return a sketch of a state for the labelling page."""
    return pictures.sketch(picture(env, state), f"step {int(state.steps) + 1}")


@jax.jit
def _held(env: JaxEnvironment, state: Running, action: Float[Array, " action"]) -> tuple[Pose, Array]:
    """Return the pose after each step of holding an action, and whether that step ended the episode."""

    def advance(state: Running, number: Array) -> Any:
        after, step = env.step(jax.random.key(number), state, action)
        return after, (pose_of(after), step.terminated | step.truncated)

    return jax.lax.scan(advance, state, jax.numpy.arange(HELD))[1]


def _clip(env: JaxEnvironment, state: Running, action: Any) -> list[Frame]:
    """Return pictures from a state on while an action is held, up to the end of the episode."""
    poses, ended = jax.device_get(_held(env, state, jax.numpy.asarray(action)))
    whole = int(np.flatnonzero(ended)[0]) if ended.any() else HELD
    return draw_poses(env, [jax.device_get(pose_of(state)), *_rows(poses, whole)])


def _rows(poses: Pose, count: int) -> list[Pose]:
    """Return the first `count` poses, one by one."""
    mocap = [None] * count if poses.mocap is None else poses.mocap
    return [Pose(poses.qpos[number], mocap[number]) for number in range(count)]


def reel(env: JaxEnvironment, state: Running, action: Float[Array, " action"]) -> Reel:
    """Return a clip of holding an action for a few steps."""
    frames = _clip(env, state, action)
    return pictures.clip(frames, PERIOD, f"held for {len(frames) - 1} steps")


def record(env: JaxEnvironment, policy: Any, key: PRNGKeyArray, steps: int) -> tuple[list[Frame], list[float]]:
    """Return a picture before each step, and each step's reward. Raises UserError as `draw_poses`."""

    @jax.jit
    def play(env: JaxEnvironment, key: PRNGKeyArray) -> Any:
        k_reset, k_play = jax.random.split(key)

        def advance(carry: Any, number: Array) -> Any:
            state, obs = carry
            k_act, k_step = jax.random.split(jax.random.fold_in(k_play, number))
            action = policy.act(k_act, jax.tree.map(lambda leaf: leaf[None], state), obs[None])[0]
            after, step = env.step(k_step, state, action)
            return (after, step.obs), (pose_of(state), step.reward)

        return jax.lax.scan(advance, env.reset(k_reset), jax.numpy.arange(steps))[1]

    poses, rewards = jax.device_get(play(env, key))
    user_code.tell()
    return draw_poses(env, _rows(poses, steps)), rewards.tolist()


def question(env: JaxEnvironment, state: Running, obs: Any, action: Any, file: Path) -> None:
    """Write two pictures side by side: the state, and the state after holding the action."""
    frames = _clip(env, state, action)
    pictures.still([frames[0], frames[-1]], file)


PICTURES = Pictures(
    record=record,
    still=lambda env, frames, file: pictures.still(frames, file),
    animate=lambda env, frames, file: pictures.animate(frames, file, FPS),
    question=question,
    sketch=sketch,
    reel=reel,
)
