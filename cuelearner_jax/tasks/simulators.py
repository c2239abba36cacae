"""Shared parts of the task families over JAX simulators: configuration, environment and preset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp

from cuelearner_envs.bounds import MOST_STEPS, check_number
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.agents import ddqn
from cuelearner_jax.arbiters import Paced
from cuelearner_jax.bridges.jax_environment import JaxEnvironment, Layout, layout_of
from cuelearner_jax.config import Schedule, Sizes
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.task import Pictures, Preset


@dataclass(frozen=True)
class SimulatorConfig:
    """Configuration of a family's environment. Every field is an option `--task.…`; its docstring is the help.

    The fields after `max_steps` describe observations and actions, so that a stored policy is read without the
    simulator.
    """

    environment: str = ""
    """Name of the environment in its library; FAMILY:NAME fills this field and the layout below."""
    max_steps: int = 1000
    """Largest number of steps of an episode, after which it is truncated."""
    slices: tuple[str, ...] = ()
    """Layout: names of an observation's slices."""
    slice_sizes: tuple[int, ...] = ()
    """Layout: numbers in each slice."""
    entries: tuple[str, ...] = ()
    """Layout: names of an action's entries, each from -1 to 1."""

    @property
    def layout(self) -> Layout:
        """The layout of observations and actions."""
        return Layout(self.slices, self.slice_sizes, self.entries)


def environment_of(family: str, config: SimulatorConfig, simulator: Callable[[], Any]) -> JaxEnvironment:
    """Return the environment of a configuration; the simulator is made at the first step or reset.

    Raises UserError for a configuration without an environment, or an invalid number.
    """
    check_number("max_steps", config.max_steps, 1, MOST_STEPS, whole=True)
    if not isinstance(config.environment, str) or not config.environment:
        raise UserError(f"task.environment is {format_value(config.environment)}: name the task {family}:ENVIRONMENT")
    layout = config.layout
    _check_row("slices", layout.slices, str)
    _check_row("slice_sizes", layout.sizes, int)
    _check_row("entries", layout.entries, str)
    if len(layout.sizes) != len(layout.slices):
        raise UserError(f"task.slice_sizes is {format_value(layout.sizes)}: give a number for each of task.slices")
    return JaxEnvironment(
        max_steps=jnp.array(config.max_steps, jnp.int32),
        simulator=simulator,
        observation=layout.observation,
        actions=layout.box(),
        to_action=None,
        heuristic=None,
    )


def _check_row(name: str, values: Any, kind: type) -> None:
    """Raise UserError unless a field holds words, or numbers above 0."""
    row = isinstance(values, tuple) and len(values) > 0
    if not row or not all(type(value) is kind and value and (kind is str or value > 0) for value in values):
        what = "names" if kind is str else "whole numbers above 0"
        raise UserError(f"task.{name} is {format_value(values)}: give {what}, or name the task FAMILY:ENVIRONMENT")


def pictures() -> Pictures:
    """Return the drawing functions of these environments."""
    from cuelearner_jax.tasks import simulator_pictures  # MuJoCo's loading is not for every command

    return simulator_pictures.PICTURES


def config_fields(family: str, name: str, simulator: Any) -> dict[str, Any]:
    """Return the fields of a configuration that follow from a simulator."""
    slices, sizes, entries = layout_of(simulator, name)
    return {"environment": name, "slices": slices, "slice_sizes": sizes, "entries": entries}


def check_layout(family: str, name: str, layout: Layout, simulator: Any) -> None:
    """Raise UserError unless a simulator has the layout of a configuration."""
    found = layout_of(simulator, name)
    if found != layout:
        raise UserError(
            f"{family}:{name} has observations of {sum(found.sizes)} entries and actions of {len(found.entries)}, the "
            f"configuration {sum(layout.sizes)} and {len(layout.entries)}, or other names: name the task "
            f"{family}:{name}, and install the {family} of the policy"
        )


def presets(config: SimulatorConfig) -> dict[str, Preset]:
    """Return the presets of one environment."""
    return {
        "quickstart": Preset(
            "small networks, 6,000 steps a seed",
            RunConfig(
                config,
                Sizes(num_envs=10, feedback_layers=(128, 128), fit_steps=400, fit_batch_size=64),
                replace(plain_scalars(config.layout.box()), discount=0.95, max_grad_norm=10.0),
                Schedule(
                    total_steps=6_000,
                    random_steps=500,
                    learn_after=500,
                    guidance_until=3_000,
                    eval_every=1_000,
                    eval_steps=1_000,
                    eval_envs=10,
                    checkpoint_every=2_000,
                ),
                ddqn.Config(
                    q_layers=(128, 128),
                    directions=256,
                    target_directions=64,
                    batch_size=64,
                    replay_capacity=50_000,
                    optimizer="adam",
                    learning_rate=0.001,
                    polyak=0.05,
                ),
                Paced(),
            ),
            guidance=("none",),
            seeds=4,
        )
    }
