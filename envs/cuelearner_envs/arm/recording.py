"""Acting step after step and keeping what a picture needs; the same as a still, a film, and on the labelling page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from PIL import Image

from cuelearner_envs.arm import model as arm
from cuelearner_envs.arm import physics
from cuelearner_envs.arm.drawing import Picture, Scene, draw, points
from cuelearner_envs.arm.environment import Arm, Situation
from cuelearner_envs.playing import record_steps
from cuelearner_jax import pictures
from cuelearner_jax.types import Policy, Reel, Sketch

HELD = 5  # steps for which a clip holds an action: one alone is hardly seen
PERIOD = 0.1  # between two frames of a clip [s]
FPS = 1.0 / arm.CONTROL_PERIOD  # of a film, a step a frame


def scene_of(env: Arm, state: Situation, action: Any = None) -> Scene:
    """Return what is drawn of a state, in arrays of NumPy; `action`: in question."""
    qpos, goal, post = jax.device_get((state.body.qpos, state.goal, env.ground.post))
    action = None if action is None else np.asarray(action, float)
    if not env.has_object:
        return Scene(np.asarray(qpos), np.zeros(2), np.asarray(goal), None, False, action)
    cube, fingers = qpos[physics.CUBE], qpos[physics.FINGERS]
    return Scene(qpos[physics.GRIPPER], fingers, np.asarray(goal), cube, bool(post > 0), action)


def record(env: Arm, policy: Policy, key: PRNGKeyArray, steps: int) -> tuple[list[Picture], list[float]]:
    """Return a picture and the reward of each of so many steps; a new episode follows the end of one."""
    rows = record_steps(env, policy, key, steps, lambda env, state, action, step: (state, step.reward))
    return [draw(scene_of(env, state)) for state, _ in rows], [float(reward) for _, reward in rows]


def question(env: Arm, state: Situation, obs: Float[Array, " obs"], action: Float[Array, "4"], file: Path) -> None:
    """Write the situation as a person is asked about it: the action in question is an arrow."""
    Image.fromarray(draw(scene_of(env, state, action))).save(file)


def sketch(env: Arm, state: Situation) -> Sketch:
    """Return the situation for the labelling page."""
    rest = int(env.max_steps) - int(state.steps)
    drawing = pictures.sketch(draw(scene_of(env, state)), f"{rest} steps left; the ring is the goal")
    return drawing._replace(points=points())


@jax.jit
def _held(env: Arm, state: Situation, action: Array) -> Situation:
    def one(state: Situation, _: None) -> tuple[Situation, Situation]:
        after = env.after(state, physics.control(state.body, env.command(state, action), env.ground))
        return after, after

    return jax.lax.scan(one, state, length=HELD)[1]


def reel(env: Arm, state: Situation, action: Float[Array, "4"]) -> Reel:
    """Return what the action leads to, held for `HELD` steps."""
    states = jax.device_get(_held(env, state, jnp.asarray(action)))
    each = [jax.tree.map(lambda leaf, number=number: leaf[number], states) for number in range(HELD)]
    frames = [draw(scene_of(env, one)) for one in (state, *each)]
    end = jax.tree.map(jnp.asarray, each[-1])
    words = "at the goal" if float(env.distance(end)) < float(env.within) else ""
    return pictures.clip(frames, PERIOD, words)
