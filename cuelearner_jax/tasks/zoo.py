"""Define the zoo task: zoo:3 has small robots with three cues, drawn by chance, each in the world of an error."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache, partial
from typing import Annotated, Literal

import jax
from jaxtyping import Array, Int, PRNGKeyArray

from cuelearner_envs.zoo import ERRORS, STEPS, ZooWorld, change, robots
from cuelearner_envs.zoo.environment import ZooEnvironment, ZooTeacher
from cuelearner_envs.zoo.worlds import Error
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.config import Bounds, Sizes, check_part
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import DIRECTIONS, Box
from cuelearner_jax.task import Body, Preset, Task

MOST_CUES = 7
Index = int | Int[Array, ""]


@dataclass(frozen=True)
class ZooConfig:
    """A robot of the zoo, and the world for it."""

    cues: Annotated[int, Bounds(1, MOST_CUES)] = 3
    """Number of cues of the robot's actions, up to 7; 1: directions in the plane."""
    number: Annotated[int, Bounds(0)] = 0
    """Which of the robots with as many cues; those with odd numbers have a neural policy, where it succeeds."""
    split: Literal["tuning", "held_out"] = "tuning"
    """Which robots: tuning, for choosing settings, or held_out, for reports."""
    error: Error = "nothing"
    """What is wrong in the world: nothing, constant, gain, mixing, seen_shift, seen_turn, region, waves, two,
    other_way, other_way_shift (`cuelearner_envs.zoo.worlds` explains them)."""
    seed: Annotated[int, Bounds(0)] = 0
    """Seed of the robots and of their errors."""

    def __post_init__(self) -> None:
        """Raise UserError with one line for the first value that cannot work."""
        check_part(self, "task")


@cache
def _world(config: ZooConfig) -> ZooWorld:
    """Return the world of a configuration, drawn once in a process."""
    error = ERRORS.index(config.error)
    with jax.ensure_compile_time_eval():
        return _draw(jax.random.key(config.seed), config.cues, config.split, config.number % 2, config.number, error)


@partial(jax.jit, static_argnames=("cues", "split", "odd"))
def _draw(key: PRNGKeyArray, cues: int, split: str, odd: int, number: Index, error: Index) -> ZooWorld:
    pair = robots(key, cues, 1 + odd, split, number - odd)  # an odd robot behind its even neighbour
    robot = jax.tree.map(lambda leaf: leaf[odd], pair)
    return change(jax.random.fold_in(jax.random.fold_in(key, cues), number), robot, error)


# Splits differ only in their episodes' keys.
ROBOT = Body("zoo", "velocity commands in a few dimensions", lambda config, split: ZooEnvironment.of(_world(config)))
ZOO = Task(
    name="zoo",
    about="small robots drawn by chance, in changed worlds: zoo:3 has those with three cues",
    wants=lambda config: "The robot is to do its task.",
    config=ZooConfig,
    bodies=(ROBOT,),
    teacher=lambda config, env: ZooTeacher(env.world),
    proposed=Heuristic,
    longest=lambda config: STEPS,
    judge_by=lambda config: "success",
)


@cache
def task_of(name: str) -> Task:
    """Return the task of the robots with as many cues as `name` says. Raises UserError for another name."""
    if name not in map(str, range(1, MOST_CUES + 1)):
        raise UserError(f"unknown robots 'zoo:{name}': give zoo:1, zoo:2, ... or zoo:{MOST_CUES}, the number of cues")
    config = ZooConfig(cues=int(name))
    space = DIRECTIONS if config.cues == 1 else Box((-1.0,) * config.cues, (1.0,) * config.cues)
    run = RunConfig(config, Sizes(), plain_scalars(space))
    preset = Preset("labels about a policy's actions", run, ("relative",), (100,))

    def environment(world: ZooConfig, split: str) -> ZooEnvironment:
        if world.cues != config.cues:  # the preset's strength of answers is that of its own space
            raise UserError(f"task.cues is {world.cues}: name zoo:{world.cues} in place of zoo:{name}")
        return ZooEnvironment.of(_world(world))

    bodies = (dataclasses.replace(ROBOT, environment=environment),)
    return dataclasses.replace(ZOO, default=config, bodies=bodies, presets={"paper": preset})
