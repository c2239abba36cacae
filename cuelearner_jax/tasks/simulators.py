"""Environments of brax and MuJoCo Playground by name: `brax:pusher`, `playground:CartpoleBalance`.

Written for playground 0.2.0, which downloads the robots of its locomotion and manipulation tasks at the first of them.
"""

from __future__ import annotations

import dataclasses
import json
import warnings
from dataclasses import dataclass
from functools import cache, partial
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from cuelearner_jax.bridges.brax import Interface, JaxEnvironment, layout_of
from cuelearner_jax.config import EPISODE, Bounds, check_part
from cuelearner_jax.environment import UNKNOWN_UNIT, Quantity
from cuelearner_jax.errors import UserError, format_value, suggestion
from cuelearner_jax.task import QUICKSTART, Body, Task
from cuelearner_jax.tasks.presets import quickstart, read

Backend = Literal["generalized", "spring", "positional", "mjx"]
VARIANTS = {"brax": "backend", "playground": "overrides"}  # each family's field of an environment's variant


@dataclass(frozen=True)
class SimulatorConfig:
    """Configuration of a family's environment. Every field is an option `--task.…`; its docstring is the help.

    The fields after `max_steps` describe observations and actions, so that a stored policy is read without the
    simulator.
    """

    environment: str = ""
    """Name of the environment in its library; FAMILY:NAME fills this field and the layout below."""
    max_steps: Annotated[int, EPISODE] = 1000
    """Largest number of steps of an episode, after which it is truncated."""
    slices: tuple[str, ...] = ()
    """Layout: names of an observation's slices."""
    slice_sizes: tuple[int, ...] = ()
    """Layout: numbers in each slice."""
    entries: tuple[str, ...] = ()
    """Layout: names of an action's entries, each from -1 to 1."""
    privileged: Annotated[int, Bounds(0)] = 0
    """Layout: numbers that critics alone see."""


@dataclass(frozen=True)
class BraxConfig(SimulatorConfig):
    """Configuration of a brax environment. Every field is an option `--task.…`; its docstring is the help."""

    backend: Backend = "generalized"
    """Physics backend of brax."""


@dataclass(frozen=True)
class PlaygroundConfig(SimulatorConfig):
    """Configuration of a Playground environment. Every field is an option `--task.…`; its docstring is the help."""

    overrides: tuple[str, ...] = ()
    """Changed entries of its own configuration, each as ENTRY=VALUE in JSON: push_config.enable=false."""


class Simulator(NamedTuple):
    """Makes the simulator of a name; equal instances return one object, and so share compilations."""

    family: str
    environment: str
    variant: Any  # brax's backend, or Playground's overrides
    layout: Interface

    def __call__(self) -> Any:
        """Return the simulator. Raises UserError if its library has none, or one of another layout."""
        own = _layout(self.family, self.environment, self.variant)
        if self.layout not in (own, own._replace(privileged=0)):  # runs before had no privileged part
            raise UserError(
                f"{self.family}:{self.environment} has other observations or actions than its configuration: name the "
                f"task {self.family}:{self.environment}, and install the {self.family} of the policy"
            )
        return _simulator(self.family, self.environment, self.variant)


@cache
def _layout(family: str, name: str, variant: Any) -> Interface:
    return layout_of(_simulator(family, name, variant), name)


@cache
def _simulator(family: str, name: str, variant: Any) -> Any:
    # An environment holds arrays, and the caller may be tracing.
    with jax.ensure_compile_time_eval():
        return (_from_brax if family == "brax" else _from_playground)(name, variant)


def _from_brax(name: str, backend: str) -> Any:
    from brax import envs  # takes seconds to load

    names: dict[str, Any] = envs._envs  # brax has no public list of its environments
    if name not in names:
        raise UserError(f"brax has no environment {name!r}{suggestion(name, names)}")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Brax System")  # a notice that brax is no longer developed
        return envs.get_environment(name, backend=backend)


def _from_playground(name: str, overrides: tuple[str, ...]) -> Any:
    try:
        from mujoco_playground import registry  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise UserError("tasks of playground need an extra: pip install 'cuelearner-jax[playground]'") from None
    if name not in registry.ALL_ENVS:
        raise UserError(f"playground has no environment {name!r}{suggestion(name, registry.ALL_ENVS)}")
    config = registry.get_default_config(name).lock()
    for override in ('impl="jax"', *overrides):
        entry, _, value = override.partition("=")
        try:
            config.update_from_flattened_dict({entry: json.loads(value)})
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"--task.overrides has {override!r}: give an entry of playground:{name}'s configuration with a value "
                "in JSON, such as push_config.enable=false"
            ) from error
    try:
        return registry.load(name, config)
    except AttributeError as error:  # MuJoCo's own interface has changed
        raise UserError(f"playground:{name} fails with the installed MuJoCo ({error}): choose another task") from error


def make_environment(family: str, config: Any, split: str = "training") -> JaxEnvironment:
    """Return the environment of a configuration; the simulator is made at the first step or reset."""
    check_part(config, "task")
    if not config.entries or len(config.slices) != len(config.slice_sizes):
        raise UserError(
            f"task.environment is {format_value(config.environment)}, and task.slices, slice_sizes or entries are of "
            f"another one: name the task {family}:ENVIRONMENT, which fills them"
        )
    slices = zip(config.slices, config.slice_sizes, strict=True)
    observation = tuple(Quantity(name, size, UNKNOWN_UNIT) for name, size in slices)
    layout = Interface(observation, config.entries, config.privileged)
    simulator = Simulator(family, config.environment, getattr(config, VARIANTS[family]), layout)
    steps = jnp.array(config.max_steps, jnp.int32)
    return JaxEnvironment(steps, simulator, observation, layout.box(), privileged=layout.privileged)


def _family(name: str, about: str, physics: str, config: type) -> Task:
    pictures = partial(resolve_name, "cuelearner_jax.tasks.frames:SIMULATOR")  # takes seconds to load
    body = Body(name, physics, partial(make_environment, name), pictures=pictures)
    return Task(
        name,
        f"{about} for instance",
        config,
        (body,),
        longest=lambda config: config.max_steps,
        judge_by=lambda config: "return",
        labels_hold=("max_steps", "privileged", VARIANTS[name]),
    )


# A label depends on one observation only.
BRAX = _family("brax", "brax's environments, each as brax:NAME, brax:pusher", "brax's own", BraxConfig)
PLAYGROUND = _family(
    "playground",
    "MuJoCo Playground's environments, each as playground:NAME, playground:CartpoleBalance",
    "MJX, MuJoCo in JAX",
    PlaygroundConfig,
)


def _task_of(family: Task, name: str) -> Task:
    """Return the task of an environment with its whole box of actions. Raises UserError for an unknown name."""
    layout = _layout(family.name, name, getattr(family.config, VARIANTS[family.name]))
    names, sizes, *_ = zip(*layout.observation, strict=True)
    config = family.config(name, 1000, names, sizes, layout.entries, layout.privileged)
    presets = read("other", config, layout.box())["presets"]
    presets[QUICKSTART] = quickstart(config, layout.box(), 10, 2, (128, 128), guidance=("none",), seeds=4)
    return dataclasses.replace(family, about=f"{family.name}'s {name}", default=config, presets=presets)


brax_task, playground_task = partial(_task_of, BRAX), partial(_task_of, PLAYGROUND)
