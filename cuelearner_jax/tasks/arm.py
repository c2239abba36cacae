"""Define the arm task: its skills, presets, changed worlds and pictures."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import jax.numpy as jnp

from cuelearner_envs.arm import config as arm
from cuelearner_envs.arm.config import SIDES, ArmConfig
from cuelearner_envs.arm.environment import ACTIONS, BASE, ScriptTeacher
from cuelearner_jax.environment import OWN, Environment, Quantity
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.task import Body, Pictures, Task
from cuelearner_jax.tasks import fetch_layout, presets
from cuelearner_jax.types import Teacher

FETCH = {"reach": "FetchReach", "push": "FetchPush", "pick": "FetchPickAndPlace"}
RELATIVE = "object relative position"
PLACES = ("achieved goal", "desired goal", "object position")  # slices that a camera measures


def observation_of(skill: str) -> tuple[Quantity, ...]:
    """Return the slices of a skill's observation: Fetch's, with the centre of the camera's rotation."""
    layout = fetch_layout.layout_of(FETCH[skill])
    assert layout is not None
    return tuple(_declared(quantity) for quantity in layout)


def _declared(quantity: Quantity) -> Quantity:
    if quantity.name in PLACES and quantity.kind != OWN:
        return quantity._replace(origin=BASE)
    return quantity._replace(follows="object position") if quantity.name == RELATIVE else quantity


def make_environment(config: ArmConfig, split: str = "training") -> Environment:
    """Return the world of a configuration; splits differ only in their episodes' keys."""
    return arm.make_environment(config, observation_of(config.skill))


def make_fetch(config: ArmConfig, split: str = "training") -> Environment:
    """Return the world of a configuration in Fetch, run by the Gymnasium bridge in separate processes."""
    from cuelearner_envs.arm import fetch
    from cuelearner_jax.bridges.gymnasium.environment import GymnasiumTask
    from cuelearner_jax.bridges.gymnasium.source import Source

    if find_spec("gymnasium_robotics") is None:
        raise UserError("Gymnasium-Robotics is not installed: pip install 'cuelearner-jax[gymnasium]'")
    observation = observation_of(config.skill)
    size = sum(quantity.size for quantity in observation)
    source = Source(f"{FETCH[config.skill]}-v4", "{}", config.max_steps, 0, size)
    return fetch.make_environment(config, GymnasiumTask(source, observation, ACTIONS))


def make_teacher(config: ArmConfig, env: Any) -> Teacher:
    """Return the skill's script, which uses the true positions."""
    return ScriptTeacher(env, jnp.float32(SIDES[config.preferred_side]))


def _wants(config: ArmConfig) -> str:
    side = "" if config.preferred_side == "none" else f", past the post on the {config.preferred_side}"
    return {
        "reach": "The gripper is to be at the green ring.",
        "push": f"The gripper is to push the cube to the green ring{side}.",
        "pick": "The gripper is to take the cube to the green ring and hold the cube there.",
    }[config.skill]


def _pictures() -> Pictures:
    from cuelearner_envs.arm import recording
    from cuelearner_jax import pictures

    return Pictures(
        record=recording.record,
        still=lambda env, frames, file: pictures.still(frames, file),
        animate=lambda env, frames, file: pictures.animate(frames, file, recording.FPS),
        question=recording.question,
        sketch=recording.sketch,
        reel=recording.reel,
        legend="A clip holds the action for five steps.",
    )


GRIPPER = Body(
    name="gripper",
    about="three slides and two fingers with contacts, simulated by MJX",
    environment=make_environment,
    engines={"mujoco": "cuelearner_envs.arm.judged:rollout"},
    pictures=_pictures,
)

ROBOT = Body(
    name="fetch",
    about="Gymnasium-Robotics' Fetch, a whole arm in C MuJoCo, in processes of their own; no post stands there",
    environment=make_fetch,
)

ARM = Task(
    name="arm",
    about="a gripper over a table: reach a place, push a cube past a post, pick a cube and place it",
    wants=_wants,
    config=ArmConfig,
    bodies=(GRIPPER, ROBOT),
    teacher=make_teacher,
    proposed=Heuristic,
    longest=lambda config: config.max_steps,
    judge_by=lambda config: "success",
    labels_hold=("reward", "max_steps", "within"),  # a label depends on one observation only
    **presets.read("arm", ArmConfig(), ACTIONS),
)
