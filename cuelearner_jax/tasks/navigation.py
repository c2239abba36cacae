"""Define the navigation task: its robots, presets, changed worlds and pictures."""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cuelearner_envs.navigation.config import SIDES, NavigationConfig, make_environment
from cuelearner_envs.navigation.roadmap import make_brief_teacher as make_brief_road_map
from cuelearner_envs.navigation.roadmap import make_teacher as make_road_map
from cuelearner_jax.environment import Environment
from cuelearner_jax.task import Body, Pictures, Task
from cuelearner_jax.tasks import presets
from cuelearner_jax.types import Teacher


def make_teacher(config: NavigationConfig, env: Any) -> Teacher:
    """Return the road map of the worlds; with a preferred side, of worlds with the other side closed."""
    side = SIDES[config.preferred_side]
    return make_road_map(env, jnp.float32(side)) if side else make_road_map(env)


def make_brief_teacher(config: NavigationConfig, env: Any, questions: int) -> Teacher | None:
    """Return a road map that is made world by world as questions come, where that is less work than all at once."""
    few = questions < config.worlds and jax.default_backend() == "cpu"
    return make_brief_road_map(env) if few and not SIDES[config.preferred_side] else None


def _wants(config: NavigationConfig) -> str:
    side = "" if config.preferred_side == "none" else f", passing each obstacle on the {config.preferred_side}"
    return f"The robot walks along the arrow and wants to get to the green goal without touching anything grey{side}."


def _pictures() -> Pictures:
    from cuelearner_envs.navigation import drawing  # takes seconds to load
    from cuelearner_envs.navigation.recording import record, situation
    from cuelearner_envs.navigation.sketch import reel, sketch

    return Pictures(
        record=record,
        still=lambda env, frames, file: drawing.still(env.robot, frames, file),
        animate=lambda env, frames, file: drawing.animate(env.robot, frames, file),
        question=lambda env, state, obs, action, file: drawing.question(env.robot, situation(env, state, action), file),
        sketch=sketch,
        reel=reel,
    )


def _legged(config: NavigationConfig, split: str, folder: Path | None = None) -> Environment:
    from cuelearner_envs.anymal import policy  # MuJoCo's loading is not for every command
    from cuelearner_envs.anymal.environment import make_environment

    return make_environment(config, split, policy.load(folder) if folder else policy.load())


def _legged_pictures() -> Pictures:
    from cuelearner_envs.anymal import recording

    return _pictures()._replace(  # what a person is asked about is as for the simple robot, which has the same lidar
        record=recording.record,
        still=lambda env, frames, file: recording.still(frames, file),
        animate=lambda env, frames, file: recording.animate(frames, file),
    )


SIMPLE = Body("simple", "a motion that follows its command with a lag", make_environment, pictures=_pictures)


def _anymal(folder: Path | None = None) -> Body:
    """Return the robot with the walking policy of a folder (None: the shipped one). Raises UserError if missing."""
    digest = ""
    if folder is not None:
        from cuelearner_envs.anymal import policy

        policy.load(folder)
        digest = hashlib.sha256((folder / policy.WEIGHTS).read_bytes()).hexdigest()[:12]
    about = "a quadruped with full physics; anymal:FOLDER walks by a policy that experiments/train_walking.py made"
    environment, engines = partial(_legged, folder=folder), {"mujoco": "cuelearner_envs.anymal.judged:rollout"}
    return Body("anymal", about, environment, engines, _legged_pictures, _anymal, digest)


ANYMAL = _anymal()

NAVIGATION = Task(
    name="navigation",
    about="reach a goal without a map, by a lidar",
    wants=_wants,
    config=NavigationConfig,
    bodies=(SIMPLE, ANYMAL),
    teacher=make_teacher,
    brief_teacher=make_brief_teacher,
    longest=lambda config: config.max_steps,
    less_is_better=(*Task.less_is_better, "duration"),
    labels_hold=("worlds", "world_seed", "max_steps", "mirrors", "look_ahead", "keep_scans"),  # labels are of one scan
    **presets.read("navigation", NavigationConfig()),
)
