"""Pictures of other libraries' environments: frames of Gymnasium's `render`, or of a MuJoCo model by its renderer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from cuelearner_envs.playing import record_steps
from cuelearner_jax import pictures, user_code
from cuelearner_jax.bridges.brax import JaxEnvironment, SimulatorState, model_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.pictures import Picture
from cuelearner_jax.task import Pictures
from cuelearner_jax.tasks import fetch_layout
from cuelearner_jax.types import Reel, Sketch

HELD = 5  # steps for which a clip holds an action, since one step is hardly visible
PERIOD = 0.1  # time between two frames of a clip [s]
SIZE = (480, 360)  # width and height of a rendered model [pixels]


def pictures_of(
    draw: Callable[[Any, Any, Any], list[Picture]],
    drawable: Callable[[Any], Any],
    film: Callable[[Any, Sequence[Any], Sequence[Any]], list[Picture]],
    points: Callable[[Any], tuple[tuple[float, float] | None, ...]] = lambda env: (),
    check: Callable[[Any], Any] | None = None,
) -> Pictures:
    """Return the drawing functions of environments that are drawn frame by frame.

    Args:
        draw: (environment, state, actions (n, action)) -> a frame of the state and one after each of the actions.
        drawable: the part of a state that a film needs.
        film: (environment, this part of the state before each step, the actions) -> frames of a roll-out.
        points: see `Sketch.points`.
        check: see `Pictures.check`.
    """

    def sketch(env: Any, state: Any) -> Sketch:
        (frame,) = draw(env, state, np.zeros((0, env.actions.size), np.float32))
        return pictures.sketch(frame, f"step {int(state.steps) + 1}")._replace(points=points(env))

    def clip(env: Any, state: Any, action: Any) -> list[Picture]:
        return draw(env, state, np.repeat(np.asarray(action, np.float32)[None], HELD, 0))

    def reel(env: Any, state: Any, action: Any) -> Reel:
        frames = clip(env, state, action)
        return pictures.clip(frames, PERIOD, f"held for {len(frames) - 1} steps")

    def question(env: Any, state: Any, obs: Any, action: Any, file: Path) -> None:
        frames = clip(env, state, action)
        pictures.still([frames[0], frames[-1]], file)

    def record(env: Any, policy: Any, key: PRNGKeyArray, steps: int) -> tuple[list[Picture], list[float]]:
        see = lambda env, state, action, step: (drawable(state), action, step.reward)  # noqa: E731
        states, actions, rewards = zip(*record_steps(env, policy, key, steps, see), strict=True)
        user_code.tell()
        return film(env, states, actions), [float(reward) for reward in rewards]

    return Pictures(
        record=record,
        still=lambda env, frames, file: pictures.still(frames, file),
        animate=lambda env, frames, file: pictures.animate(frames, file),
        question=question,
        sketch=sketch,
        reel=reel,
        check=check,
    )


# --- Gymnasium: a spare instance replays an episode's actions --------------------------------------------------------


def _replayed(env: Any, seed: Any, place: Any, history: Any, actions: Any) -> list[Picture]:
    """Return pictures after an episode's `history` and each of the actions. Raises UserError away from `place`."""
    from cuelearner_jax.bridges.gymnasium.pool import Request, pool_of

    source = env.source
    if source.factory is None:
        source = dataclasses.replace(source, arguments=fetch_layout.picture_arguments(source.name, source.arguments))
    history, actions = (np.asarray(rows, np.float32).reshape(-1, env.actions.size) for rows in (history, actions))
    request = Request(int(seed), np.asarray(place, np.uint32).tobytes(), history=history)
    return pool_of(dataclasses.replace(source, draws=True)).film(request, actions)


def _drawn_instance(env: Any, state: Any, actions: Any) -> list[Picture]:
    seed, steps, history, place = jax.device_get((state.seed, state.steps, state.actions, state.place))
    return _replayed(env, seed, place, history[:steps], actions)


def _filmed_episodes(env: Any, states: Sequence[Any], actions: Sequence[Any]) -> list[Picture]:
    begins = [number for number, (_, steps, _) in enumerate(states) if steps == 0]
    frames = []
    for first, end in zip(begins, [*begins[1:], len(states)], strict=True):
        seed, _, place = states[end - 1]
        _replayed(env, seed, place, actions[first : end - 1], ())  # pictures on the way may move it by a rounding
        frames += _replayed(env, seed, (), (), actions[first:end])
    return frames


GYMNASIUM = pictures_of(
    _drawn_instance,
    lambda state: (state.seed, state.steps, state.place),
    _filmed_episodes,
    lambda env: () if env.source.factory else fetch_layout.points_of(env.source.name, env.source.arguments),
    check=lambda env: _replayed(env, 0, (), (), ()),
)


# --- brax and Playground: the model of the simulator in the poses of its states --------------------------------------


def pose_of(state: SimulatorState) -> tuple[Any, Any]:
    """Return a state's joint positions and those of bodies without joints (None: the simulator has no such bodies).

    Raises UserError for a simulator unlike MuJoCo's.
    """
    if hasattr(state.state, "data"):
        return state.state.data.qpos, state.state.data.mocap_pos
    physics: Any = getattr(state.state, "pipeline_state", None)
    if not hasattr(physics, "q"):
        raise UserError("this simulator has no bodies to draw: evaluate a policy in it instead")
    return physics.q, None


def draw_poses(env: JaxEnvironment, poses: Sequence[tuple[Any, Any]]) -> list[Picture]:
    """Return a picture of each pose. Raises UserError for an environment without a MuJoCo model, or without OpenGL."""
    import mujoco

    from cuelearner_envs.anymal.scene import Studio

    library: Any = mujoco  # whose compiled module has no stubs
    if (model := model_of(env.simulator())) is None:
        raise UserError("this environment has no MuJoCo model to draw: evaluate a policy in it instead")
    camera = library.MjvCamera()
    library.mjv_defaultFreeCamera(model, camera)
    if model.ncam:
        camera.type, camera.fixedcamid = library.mjtCamera.mjCAMERA_FIXED, 0
    frames = []
    with Studio(model, *SIZE) as studio:
        for joints, bodies in poses:
            if bodies is not None and model.nmocap:
                studio.data.mocap_pos[:] = bodies
            studio.pose(np.asarray(joints))
            frames.append(np.ascontiguousarray(studio.picture(camera)))
    return frames


_step = jax.jit(lambda env, key, state, action: env.step(key, state, action))


def _drawn_model(env: JaxEnvironment, state: SimulatorState, actions: Any) -> list[Picture]:
    poses = [pose_of(state)]
    for number, action in enumerate(actions):
        state, step = _step(env, jax.random.key(number), state, action)
        if step.terminated | step.truncated:
            break
        poses.append(pose_of(state))
    return draw_poses(env, poses)


SIMULATOR = pictures_of(_drawn_model, pose_of, lambda env, poses, actions: draw_poses(env, poses))
