"""Define the navigation task: its robots, presets, changed worlds and pictures."""

from __future__ import annotations

import dataclasses
import hashlib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cuelearner_envs.navigation.config import SIDES, NavigationConfig, make_environment
from cuelearner_envs.navigation.roadmap import make_brief_teacher as make_brief_road_map
from cuelearner_envs.navigation.roadmap import make_sided_teacher
from cuelearner_envs.navigation.roadmap import make_teacher as make_road_map
from cuelearner_jax.agents import ddqn
from cuelearner_jax.arbiters import Paced
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.environment import Environment
from cuelearner_jax.guides import scalar
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.task import PAPERS_FIT, Body, Pictures, Preset, Scenario, Task
from cuelearner_jax.types import Teacher

NAVIGATION_SIZES = Sizes(num_envs=10)
NAVIGATION_KINDS = {"scalar": scalar.Config(guide_directions=72)}

# The paper's discount, eps, step size, and what scalar feedback calls good. The bound on the gradient's norm (0.5) and
# the target network's rate (0.005) of its billiards code learn more slowly here, see docs/results/training.md.
NAVIGATION_SCALARS = Scalars(discount=0.995, eps_deg=20.0, scalar_within_deg=20.0, max_grad_norm=10.0)
NAVIGATION_AGENT = ddqn.Config(
    directions=360, target_directions=18, n_step=30, replay_capacity=100_000, learning_rate=0.001, polyak=0.05
)


def make_teacher(config: NavigationConfig, env: Any) -> Teacher:
    """Return the road map of the worlds; with a preferred side, of worlds with the other side closed."""
    side = SIDES[config.preferred_side]
    return make_sided_teacher(env, jnp.float32(side)) if side else make_road_map(env)


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


def _judged(*arguments: Any) -> dict[str, Any]:
    from cuelearner_envs.anymal.judged import rollout

    return rollout(*arguments)


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
    environment = partial(_legged, folder=folder)
    return Body("anymal", about, environment, {"mujoco": _judged}, _legged_pictures, _anymal, digest)


ANYMAL = _anymal()

# The best settings of adaptation where a way has to be chosen, see docs/results/adaptation.md. Labels are read as a
# choice among the ways seen by the lidar, and the likeliest is taken. Questions are far apart, in rounds of fifty.
BY_WAYS: dict[str, Any] = {
    "guidance": "intent",
    "eps_deg": 20.0,
    "sizes": {"ensemble": 5, "labels_per_round": 50, "question_every": 10},
    "options": {"aim_layers": (64, 64), "aim_doubt": 1000.0},
}

# The worlds of the paper's section on adaptation after training.
SCENARIOS = {
    "turned_lidar": Scenario(
        "the lidar is mounted turned by 15 degrees",
        {"lidar_rotation_deg": 15.0},
        bound_deg=60.0,
        eps_deg=2.0,
        guidance="relative",
        judge_by="success",
        judge_bounds=(0.5, 0.25),  # these recovered most of the loss, see docs/results/adaptation.md
        sizes={"frame": "action", **PAPERS_FIT},
    ),
    "rooms": Scenario(
        "rooms, doorways and thin obstacles",
        {"style": "rooms", "look_ahead": True},  # improved agents' distance, see docs/results/adaptation.md
        bound_deg=180.0,
        judge_by="success",
        **BY_WAYS,
    ),
    "corridor": Scenario(
        "a corridor of obstacles, each to be passed left or right", {"style": "corridor"}, bound_deg=60.0
    ),
    **{
        f"corridor_{side}": Scenario(
            f"the corridor, and a wish: pass every obstacle on the {side}",
            {"style": "corridor", "preferred_side": side},
            bound_deg=180.0,
            judge_by=f"passed_{side}",
            **{**BY_WAYS, "sizes": {**BY_WAYS["sizes"], **PAPERS_FIT}},
        )
        for side in ("left", "right")
    },
}

NAVIGATION = Task(
    name="navigation",
    about="reach a goal without a map, by a lidar",
    wants=_wants,
    config=NavigationConfig,
    bodies=(SIMPLE, ANYMAL),
    teacher=make_teacher,
    brief_teacher=make_brief_teacher,
    scenarios=SCENARIOS,
    longest=lambda config: config.max_steps,
    labels_hold=("worlds", "world_seed", "max_steps", "mirrors", "look_ahead"),  # a label depends on one scan only
    presets={
        "paper": Preset(
            "the paper's figure: cluttered halls, its networks, 1 million steps a seed",
            RunConfig(
                NavigationConfig(),
                NAVIGATION_SIZES,
                NAVIGATION_SCALARS,
                Schedule(
                    total_steps=1_000_000,
                    random_steps=1_000,
                    learn_after=1_000,
                    guidance_until=500_000,
                    eval_every=50_000,
                    eval_steps=50_000,
                    eval_envs=250,
                    checkpoint_every=100_000,
                    guide_eval_every=50,
                ),
                NAVIGATION_AGENT,
                kinds=NAVIGATION_KINDS,
            ),
            guidance=("none", "relative", "heuristic"),
            labels=(100, 350, 500),
            seeds=16,
            takes="16 seeds under one guidance: half an hour on one H200; one: half a day on 2 cores, by arithmetic",
        ),
        "quickstart": Preset(
            "few worlds, small networks, 6,000 steps a seed",
            RunConfig(
                NavigationConfig(worlds=128),
                dataclasses.replace(NAVIGATION_SIZES, feedback_layers=(128, 128), fit_steps=400, fit_batch_size=64),
                NAVIGATION_SCALARS,
                Schedule(
                    total_steps=6_000,
                    random_steps=1_000,
                    learn_after=1_000,
                    guidance_until=6_000,
                    eval_every=1_000,
                    eval_steps=10_000,
                    eval_envs=50,
                    checkpoint_every=3_000,
                ),
                dataclasses.replace(
                    NAVIGATION_AGENT,
                    q_layers=(128, 128),
                    directions=36,
                    target_directions=12,
                    batch_size=64,
                    replay_capacity=50_000,
                    learning_rate=0.003,
                ),
                Paced(lead=0.0),  # returns go up to 10; leads of 2, 5 and 10 were not shown to help
                NAVIGATION_KINDS,
            ),
            guidance=("none", "relative"),
            labels=(350,),
            seeds=4,
            first_seed=1000,  # the settings were chosen on seeds below 1000
            takes="4 seeds under two kinds of guidance: two to three minutes on 2 cores",
        ),
    },
)
