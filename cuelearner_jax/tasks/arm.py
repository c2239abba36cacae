"""Define the arm task: its skills, presets, changed worlds and pictures."""

from __future__ import annotations

import dataclasses
from importlib.util import find_spec
from typing import Any

import jax.numpy as jnp

from cuelearner_envs.arm import config as arm
from cuelearner_envs.arm.config import SIDES, ArmConfig
from cuelearner_envs.arm.environment import ACTIONS
from cuelearner_envs.arm.places import BASE
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.agents import sac
from cuelearner_jax.arbiters import Episodes, Paced
from cuelearner_jax.config import Schedule, Sizes
from cuelearner_jax.environment import OWN, Environment, Quantity
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.task import PAPERS_FIT, Body, Pictures, Preset, Scenario, Task
from cuelearner_jax.tasks import fetch_layout
from cuelearner_jax.types import Teacher

FETCH = {"reach": "FetchReach", "push": "FetchPush", "pick": "FetchPickAndPlace"}
RELATIVE = "object relative position"
PLACES = ("achieved goal", "desired goal", "object position")  # slices that a camera measures


def observation_of(skill: str) -> tuple[Quantity, ...]:
    """Return the slices of a skill's observation: Fetch's, with the centre of the camera's rotation."""
    layout = fetch_layout.layout_of(FETCH[skill])
    assert layout is not None
    return tuple(_seen(quantity) for quantity in layout)


def _seen(quantity: Quantity) -> Quantity:
    if quantity.name in PLACES and quantity.kind != OWN:
        return quantity._replace(origin=BASE)
    return quantity._replace(follows="object position") if quantity.name == RELATIVE else quantity


def make_environment(config: ArmConfig, split: str = "training") -> Environment:
    """Return the world of a configuration; splits differ only in their episodes' keys."""
    return arm.make_environment(config, observation_of(config.skill))


def make_fetch(config: ArmConfig, split: str = "training") -> Environment:
    """Return the world of a configuration in Fetch, run by the Gymnasium bridge in separate processes.

    Raises UserError for a change that Fetch does not support, or where Gymnasium-Robotics is not installed.
    """
    from cuelearner_envs.arm import fetch
    from cuelearner_jax.bridges.gymnasium.environment import GymnasiumTask
    from cuelearner_jax.bridges.gymnasium.source import Source

    if find_spec("gymnasium_robotics") is None:
        raise UserError("Gymnasium-Robotics is not installed: pip install 'cuelearner-jax[gymnasium]'")
    observation = observation_of(config.skill)
    size = sum(quantity.size for quantity in observation)
    source = Source(f"{FETCH[config.skill]}-v4", "{}", config.max_steps, 0, size)
    return fetch.make_environment(config, GymnasiumTask(source=source, observation=observation, actions=ACTIONS))


def make_teacher(config: ArmConfig, env: Any) -> Teacher:
    """Return the skill's script, which uses the true positions."""
    from cuelearner_envs.arm.teacher import ScriptTeacher

    return ScriptTeacher(env, jnp.float32(SIDES[config.preferred_side]))


def _wants(config: ArmConfig) -> str:
    side = "" if config.preferred_side == "none" else f", past the post on the {config.preferred_side}"
    return {
        "reach": "The gripper is to be at the green ring.",
        "push": f"The gripper is to push the cube to the green ring{side}.",
        "pick": "The gripper is to take the cube to the green ring and hold the cube there.",
    }[config.skill]


def _judged(*arguments: Any) -> dict[str, Any]:
    from cuelearner_envs.arm.judged import rollout

    return rollout(*arguments)


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
    engines={"mujoco": _judged},
    pictures=_pictures,
)

ROBOT = Body(
    name="fetch",
    about="Gymnasium-Robotics' Fetch, a whole arm in C MuJoCo, in processes of their own; no post stands there",
    environment=make_fetch,
)

_CAMERA: dict[str, Any] = {"guidance": "reading"}
SCENARIOS = {
    "turned_camera": Scenario(
        "the camera is turned by 10 degrees about the robot's base", {"camera_turn_deg": 10.0}, **_CAMERA
    ),
    "hand_eye": Scenario(
        "the camera stands 2 cm to the right of where the arm believes", {"camera_offset": (0.0, 0.02, 0.0)}, **_CAMERA
    ),
    "slippery": Scenario("the cube is slippery", {"friction": 0.12}),
    **{
        f"past_{side}": Scenario(
            f"a wish: push the cube past the post on the {side}",
            {"preferred_side": side},
            judge_by=f"passed_{side}",
        )
        for side in ("left", "right")
    },
}

QUICKSTART = RunConfig(
    ArmConfig(),
    Sizes(num_envs=16, feedback_layers=(64, 64), fit_steps=400, fit_batch_size=64),
    dataclasses.replace(plain_scalars(ACTIONS), discount=0.95, max_grad_norm=10.0),
    Schedule(
        total_steps=32_000,
        random_steps=800,
        learn_after=800,
        guidance_until=16_000,
        eval_every=4_000,
        eval_steps=1_000,
        eval_envs=20,
        checkpoint_every=8_000,
    ),
    sac.Config(
        actor_layers=(64, 64),
        critic_layers=(64, 64),
        batch_size=128,
        replay_capacity=64_000,
        actor_rate=1e-3,
        critic_rate=1e-3,
        temperature_rate=1e-3,
        first_temperature=0.1,  # rewards are distances in metres
        polyak=0.02,
    ),
    Paced(lead=0.0),
)
PAPER = dataclasses.replace(
    QUICKSTART,
    sizes=dataclasses.replace(QUICKSTART.sizes, **PAPERS_FIT),
    schedule=dataclasses.replace(
        QUICKSTART.schedule,
        total_steps=1_000_000,
        guidance_until=500_000,
        eval_every=50_000,
        eval_steps=5_000,
        eval_envs=100,
        checkpoint_every=100_000,
    ),
    agent=dataclasses.replace(
        QUICKSTART.agent,
        actor_layers=(256, 256),
        critic_layers=(256, 256),
        layer_norm=True,
        batch_size=256,
        replay_capacity=1_000_000,
    ),
)
# In whole episodes each answer corrects the middle action by a quarter of a range, the strength at which such episodes
# succeed most often (push 84%, pick 82%: measured in commit f02b6741). The corrected steps are half of every
# minibatch.
CORRECTED = dataclasses.replace(
    PAPER,
    sizes=dataclasses.replace(PAPER.sizes, store_labelled=True, ask_from="middle"),
    scalars=dataclasses.replace(PAPER.scalars, eps_deg=0.25, refined_fraction=0.0),
    schedule=dataclasses.replace(
        PAPER.schedule,
        total_steps=480_000,
        guidance_until=480_000,
        eval_every=24_000,
        checkpoint_every=120_000,
    ),
    agent=dataclasses.replace(PAPER.agent, replay_capacity=480_000),
    arbiter=Episodes(probability=0.0),
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
    scenarios=SCENARIOS,
    presets={
        "paper": Preset(
            "larger networks, 1 million steps a seed; --task.skill chooses the skill",
            PAPER,
            guidance=("none", "relative"),
            labels=(100, 500),
            takes="one seed: hours on 2 cores, by arithmetic",
        ),
        "corrected": Preset(
            "as `paper`, but labels correct the steps that the agent begins to learn from, 480,000 steps a seed",
            CORRECTED,
            guidance=("none", "relative"),
            labels=(500,),
            takes="one seed: hours on 2 cores, by arithmetic; eight: 12 minutes on one H200",
        ),
        "quickstart": Preset(
            "small networks, 32,000 steps a seed; --task.skill chooses the skill",
            QUICKSTART,
            guidance=("none", "relative"),
            labels=(100,),
            seeds=1,
            takes="one seed under two kinds of guidance: minutes on 2 cores",
        ),
    },
)
