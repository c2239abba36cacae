"""Define brax's environments as tasks, by name: `brax:pusher`."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, get_args

import jax

from cuelearner_envs.bounds import check_word
from cuelearner_jax.bridges.jax_environment import JaxEnvironment, Layout
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.task import Body, Task
from cuelearner_jax.tasks.simulators import (
    SimulatorConfig,
    check_layout,
    config_fields,
    environment_of,
    pictures,
    presets,
)

FAMILY = "brax"
Backend = Literal["generalized", "spring", "positional", "mjx"]


@dataclass(frozen=True)
class BraxConfig(SimulatorConfig):
    """Configuration of a brax environment. Every field is an option `--task.…`; its docstring is the help."""

    backend: Backend = "generalized"
    """Physics backend of brax."""


@dataclass(frozen=True)
class Simulator:
    """Makes the brax environment of a name; equal instances return one object, and so share compilations."""

    environment: str
    backend: str
    layout: Layout

    def __call__(self) -> Any:
        """Return the environment. Raises UserError if brax has none, or one of another layout."""
        env = _made(self.environment, self.backend)
        check_layout(FAMILY, self.environment, self.layout, env)
        return env


@cache
def _made(name: str, backend: str) -> Any:
    from brax import envs  # takes seconds to load

    known: dict[str, Any] = envs._envs  # brax has no public list of its environments
    if name not in known:
        raise UserError(f"brax has no environment {name!r}{suggestion(name, known)}")
    # the environment holds arrays, and the caller may be tracing
    with warnings.catch_warnings(), jax.ensure_compile_time_eval():
        warnings.filterwarnings("ignore", message="Brax System")  # a notice that brax is no longer developed
        return envs.get_environment(name, backend=backend)


def make_environment(config: BraxConfig, split: str = "training") -> JaxEnvironment:
    """Return the environment of a configuration. Raises UserError for a value that makes none."""
    check_word("backend", config.backend, get_args(Backend))
    return environment_of(FAMILY, config, Simulator(config.environment, config.backend, config.layout))


BRAX = Task(
    name=FAMILY,
    about="brax's environments, each as brax:NAME, brax:pusher for instance",
    config=BraxConfig,
    bodies=(Body(FAMILY, "brax's own", make_environment, pictures=pictures),),
    labels_hold=("max_steps", "backend"),  # a label depends on one observation only
)


@cache
def task_of(name: str) -> Task:
    """Return the task of a brax environment with its whole box of actions. Raises UserError for an unknown name."""
    config = BraxConfig(**config_fields(FAMILY, name, _made(name, BraxConfig.backend)))
    return dataclasses.replace(BRAX, about=f"brax's {name}", default=config, presets=presets(config))
