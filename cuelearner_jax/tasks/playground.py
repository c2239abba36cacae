"""Define MuJoCo Playground's dm_control tasks, by name: `playground:CartpoleBalance`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache
from typing import Any

from cuelearner_jax.bridges import playground
from cuelearner_jax.bridges.jax_environment import JaxEnvironment, Layout
from cuelearner_jax.task import Body, Task
from cuelearner_jax.tasks.simulators import (
    SimulatorConfig,
    check_layout,
    config_fields,
    environment_of,
    pictures,
    presets,
)

FAMILY = "playground"


@dataclass(frozen=True)
class PlaygroundConfig(SimulatorConfig):
    """Configuration of a Playground task. Every field is an option `--task.…`; its docstring is the help."""


@dataclass(frozen=True)
class Simulator:
    """Makes the Playground task of a name; equal instances return one object, and so share compilations."""

    environment: str
    layout: Layout

    def __call__(self) -> Any:
        """Return the task. Raises UserError if it is not available, or has another layout."""
        env = _made(self.environment)
        check_layout(FAMILY, self.environment, self.layout, env)
        return env


@cache
def _made(name: str) -> Any:
    return playground.make(name)


def make_environment(config: PlaygroundConfig, split: str = "training") -> JaxEnvironment:
    """Return the environment of a configuration. Raises UserError for a value that makes none."""
    return environment_of(FAMILY, config, Simulator(config.environment, config.layout))


PLAYGROUND = Task(
    name=FAMILY,
    about="MuJoCo Playground's dm_control tasks, each as playground:NAME, playground:CartpoleBalance for instance",
    config=PlaygroundConfig,
    bodies=(Body(FAMILY, "MJX, MuJoCo in JAX", make_environment, pictures=pictures),),
    labels_hold=("max_steps",),  # a label depends on one observation only
)


@cache
def task_of(name: str) -> Task:
    """Return one of Playground's dm_control tasks with its whole box of actions. Raises UserError if unavailable."""
    config = PlaygroundConfig(**config_fields(FAMILY, name, _made(name)))
    return dataclasses.replace(PLAYGROUND, about=f"Playground's {name}", default=config, presets=presets(config))
