"""What the families of tasks over JAX simulators share: the configuration, the environment, the preset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from cuelearner_envs.bounds import MOST_STEPS, check_number
from cuelearner_jax.agents import ddqn
from cuelearner_jax.arbiters import paced
from cuelearner_jax.bridges.jax_environment import JaxEnvironment, Layout, layout_of
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.errors import UserError, shown
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.task import Preset


@dataclass(frozen=True)
class SimulatorConfig:
    """One environment of a family. Every field is an option `--task.…`, the line below it its help.

    The fields after `max_steps` say what policies look at, so that a stored policy is read without the simulator.
    """

    environment: str = ""
    """The family's name of the environment; FAMILY:NAME fills it, and the layout below."""
    max_steps: int = 1000
    """Steps after which an episode is truncated."""
    slices: tuple[str, ...] = ()
    """Layout: names of an observation's slices."""
    slice_sizes: tuple[int, ...] = ()
    """Layout: numbers in each slice."""
    entries: tuple[str, ...] = ()
    """Layout: names of an action's entries, each from -1 to 1."""

    @property
    def layout(self) -> Layout:
        """What policies look at."""
        return Layout(self.slices, self.slice_sizes, self.entries)


def environment_of(family: str, config: SimulatorConfig, simulator: Callable[[], Any]) -> JaxEnvironment:
    """Return the environment of a configuration; the simulator is made when it is first stepped or reset.

    Raises UserError for a configuration that names no environment, or a number that makes no sense.
    """
    check_number("max_steps", config.max_steps, 1, MOST_STEPS, whole=True)
    if not isinstance(config.environment, str) or not config.environment:
        raise UserError(f"task.environment is {shown(config.environment)}: name the task {family}:ENVIRONMENT")
    layout = config.layout
    sound = layout.sizes and len(layout.sizes) == len(layout.slices) and min(layout.sizes) > 0 and layout.entries
    if not sound:
        raise UserError(
            f"the layout of {family}:{config.environment} is not whole: name the task {family}:{config.environment}"
        )
    return JaxEnvironment(
        max_steps=jnp.array(config.max_steps, jnp.int32),
        simulator=simulator,
        observation=layout.observation,
        actions=layout.box(),
        to_action=None,
        heuristic=None,
    )


def described(family: str, name: str, simulator: Any) -> dict[str, Any]:
    """Return the fields of a configuration that follow from a simulator."""
    slices, sizes, entries = layout_of(simulator, name)
    return {"environment": name, "slices": slices, "slice_sizes": sizes, "entries": entries}


def check_layout(family: str, name: str, layout: Layout, simulator: Any) -> None:
    """Raise UserError unless a simulator has the layout of a configuration."""
    found = layout_of(simulator, name)
    if found != layout:
        wanted = f"observations {layout.sizes} and {len(layout.entries)} action entries"
        raise UserError(
            f"{family}:{name} has observations {found.sizes} and {len(found.entries)} action entries, the configuration "
            f"{wanted}: name the task {family}:{name}, with the version of the simulator that the policy was trained in"
        )


def presets(config: SimulatorConfig) -> dict[str, Preset]:
    """Return the presets of one environment."""
    return {
        "quickstart": Preset(
            "small networks, 6,000 steps a seed",
            RunConfig(
                config,
                Sizes(num_envs=10, feedback_layers=(128, 128), fit_steps=400, fit_batch_size=64),
                Scalars(discount=0.95, max_grad_norm=10.0, eps_deg=0.1, scalar_within_deg=0.1, tau_deg=0.001),
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
                paced.Config(),
            ),
            guidance=("none",),
            seeds=4,
        )
    }
