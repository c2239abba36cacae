"""The tasks that the command line offers: the one place where the method meets the environments.

A task is its configuration, its environment and teacher, its presets and its pictures. Add one here and every command
knows it.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cuelearner_envs import billiards
from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.recording import record
from cuelearner_envs.billiards.teacher import SearchTeacher
from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_envs.navigation.config import make_environment as make_navigation
from cuelearner_envs.navigation.recording import record as navigation_record
from cuelearner_envs.navigation.roadmap import make_teacher
from cuelearner_jax.config import RunConfig, Scalars, Schedule, Sizes
from cuelearner_jax.environment import Environment
from cuelearner_jax.teachers import learned
from cuelearner_jax.types import Teacher


@dataclass(frozen=True)
class Preset:
    """A named starting point: a configuration and the lanes that a sweep runs by default."""

    about: str
    config: RunConfig
    guidance: tuple[str, ...] = ("none", "relative", "heuristic")
    labels: tuple[int, ...] = (500, 1000)
    seeds: int = 5
    first_seed: int = 0


@dataclass(frozen=True)
class Robot:
    """Another body for a task, to agents the same: policies of the task act on it unchanged."""

    about: str
    environment: Callable[..., Environment]  # as `Task.environment`
    engines: dict[str, Callable[..., dict[str, Any]]]  # roll-outs as `evaluate.rollout` in other physics, by name
    pictures: Callable[
        [], tuple[Callable, Callable, Callable]
    ]  # loads `record`, `still`, `animate`, as a task has them


@dataclass(frozen=True)
class Task:
    """One task as the command line sees it."""

    name: str
    config: type  # its configuration dataclass
    environment: Callable[..., Environment]  # (configuration, split="training"); for the splits see `evaluate.SPLITS`
    teacher: Callable[[Any, Environment], Teacher]
    presets: dict[str, Preset]
    record: Callable[
        ..., tuple[list[Any], list[float]]
    ]  # (env, policy, key, steps) -> frames for the two below, rewards
    still: Callable[[Any, list[Any], Path], None]  # (env, the frames of a record, file)
    animate: Callable[[Any, list[Any], Path], None]  # (env, the frames, file)
    robots: dict[str, Robot] = field(default_factory=dict)  # beside its own


def _drawing(task: str) -> Any:
    """The module that draws a task, loaded when something is drawn: it takes seconds."""
    return importlib.import_module(f"cuelearner_envs.{task}.drawing")


def shape_of(task: Task, config: Any) -> Any:
    """The environment of a configuration with shapes in place of arrays: costs next to nothing."""
    return jax.eval_shape(lambda: task.environment(config))


def billiards_teacher(config: BilliardsConfig, env: Any) -> Teacher:
    """The teacher that a configuration names. Raises UserError if the table has no shipped one."""
    aim_error = jnp.deg2rad(jnp.array(config.aim_error_deg, jnp.float32))
    habit = jnp.array(config.habit, jnp.float32)
    if config.teacher == "search":
        return SearchTeacher(env, aim_error, habit, config.search_directions)
    return learned.load(SHIPPED_TEACHERS / config.table, env, aim_error, habit)


SHIPPED_TEACHERS = Path(billiards.__file__).parent / "teachers"

BILLIARDS = Task(
    name="billiards",
    config=BilliardsConfig,
    environment=lambda config, split="training": make_environment(config),  # racks alone differ, and they by the key
    teacher=billiards_teacher,
    record=record,
    still=lambda env, paths, file: _drawing("billiards").still(env.table, paths[0], file),
    animate=lambda env, paths, file: _drawing("billiards").animate(env.table, paths, file),
    presets={
        "paper": Preset(
            "the paper's figure: regulation table, its networks, 10 million steps a seed",
            RunConfig(
                BilliardsConfig("regulation", teacher="learned", aim_error_deg=0.25),
                # The reference alternates 1,000 steps with 1,000 gradient steps, this a hundred with a hundred.
                Sizes(num_envs=100, coarse_directions=360, coarse_dtype="bfloat16", peaks=4),
            ),
            labels=(500, 1000),
        ),
        "easy": Preset(
            "larger balls and pockets, the paper's networks, 1 million steps a seed",
            RunConfig(
                BilliardsConfig("easy", teacher="learned"),
                Sizes(directions=720, num_envs=100, replay_capacity=1_000_000),
                Scalars(),
                Schedule(total_steps=1_000_000, guidance_until=500_000, checkpoint_every=100_000),
            ),
        ),
        "quickstart": Preset(
            "one ball, small networks: minutes on two CPU cores",
            RunConfig(
                BilliardsConfig("one_ball"),
                Sizes(
                    q_layers=(128, 128),
                    feedback_layers=(128, 128),
                    directions=360,
                    num_envs=10,
                    replay_capacity=20_000,
                    fit_steps=400,
                    fit_batch_size=64,
                ),
                Scalars(learning_rate=0.01, eps_deg=2.0, k_max=100),
                Schedule(
                    total_steps=3_000,
                    random_steps=200,
                    learn_after=200,
                    guidance_until=1_500,
                    eval_every=100,
                    eval_steps=100,
                    eval_envs=50,
                    checkpoint_every=500,
                ),
            ),
            guidance=("none", "relative"),
            labels=(100,),
            seeds=24,
            first_seed=2000,  # the settings were chosen on seeds below
        ),
    },
)

NAVIGATION_SIZES = Sizes(
    directions=360,
    target_directions=18,
    n_step=30,
    num_envs=10,
    replay_capacity=100_000,
)

# The paper's step size, discount and eps. The bound on the gradient's norm (0.5) and the target network's rate (0.005)
# of its billiards code learn more slowly here, see docs/results.md.
NAVIGATION_SCALARS = Scalars(learning_rate=0.001, discount=0.995, eps_deg=20.0, max_grad_norm=10.0, polyak=0.05)


def _legged(config: NavigationConfig, split: str = "training") -> Environment:
    from cuelearner_envs.anymal.environment import make_environment  # MuJoCo's loading is not for every command

    return make_environment(config, split)


def _judged(*arguments: Any) -> dict[str, Any]:
    from cuelearner_envs.anymal.judged import rollout

    return rollout(*arguments)


def _legged_pictures() -> tuple[Callable, Callable, Callable]:
    from cuelearner_envs.anymal import recording

    return (
        recording.record,
        lambda env, frames, file: recording.still(frames, file),
        lambda env, frames, file: recording.animate(frames, file),
    )


NAVIGATION = Task(
    name="navigation",
    config=NavigationConfig,
    environment=make_navigation,
    teacher=lambda config, env: make_teacher(env),
    record=navigation_record,
    still=lambda env, frames, file: _drawing("navigation").still(env.robot, frames, file),
    animate=lambda env, frames, file: _drawing("navigation").animate(env.robot, frames, file),
    robots={"anymal": Robot("a quadruped with full physics", _legged, {"mujoco": _judged}, _legged_pictures)},
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
                ),
            ),
            labels=(100, 350, 500),
            seeds=16,
        ),
        "quickstart": Preset(
            "few worlds, small networks: minutes on two CPU cores",
            RunConfig(
                NavigationConfig(worlds=128),
                dataclasses.replace(
                    NAVIGATION_SIZES,
                    q_layers=(128, 128),
                    feedback_layers=(128, 128),
                    directions=36,
                    target_directions=12,
                    batch_size=64,
                    replay_capacity=50_000,
                    fit_steps=400,
                    fit_batch_size=64,
                ),
                dataclasses.replace(NAVIGATION_SCALARS, learning_rate=0.003),
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
            ),
            guidance=("none", "relative"),
            labels=(350,),
            seeds=4,
            first_seed=1000,  # the settings were chosen on seeds below
        ),
    },
)

TASKS = {task.name: task for task in (BILLIARDS, NAVIGATION)}


def anymal_walker() -> Any:
    """The quadruped that learns to walk."""
    from cuelearner_envs.anymal import policy, tracking
    from cuelearner_envs.anymal.locomotion import Locomotion
    from cuelearner_jax.brax_bridge.walking import Walker

    return Walker(
        environment=Locomotion(),
        policy=policy.from_brax,
        measure=tracking.measure_training,
        examine=tracking.examine,
        save=policy.save,
        load=policy.load,
    )
