"""Worlds and teachers by name, and the arrays that callers give them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.config import LARGEST_FLOAT, normalize_options
from cuelearner_jax.environment import Environment, Quantity, actions_of
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.evaluate import SPLITS
from cuelearner_jax.policies import Teaching, policy_of, teaching
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import Space
from cuelearner_jax.task import PAPER, Body, Preset, Task
from cuelearner_jax.tasks import registry
from cuelearner_jax.types import EnvState, Step, Teacher


@dataclasses.dataclass(frozen=True)
class World:
    """A task in one configuration: environments for training and evaluation, and its teacher."""

    task: Task
    config: Any
    scenario: str | None = None  # name of the scenario, whose suggestions `adapt` follows

    def __post_init__(self) -> None:
        """Take numbers of NumPy in the configuration as Python's."""
        object.__setattr__(self, "config", normalize_options(self.config, "task"))

    @cached_property
    def env(self) -> Environment:
        """The environment that agents train in: a pytree, see `environment.Environment`."""
        return self.environment("training")

    @user_code.report_user_errors
    def environment(self, split: str) -> Environment:
        """Return the environment of a split: "training", "tuning" or "validation". Raises UserError for other names."""
        if split not in (splits := ("training", *SPLITS)):
            raise UserError(f"split is {format_value(split)}: give one of {', '.join(splits)}")
        return self.task.environment(self.config, split)

    @property
    def observation(self) -> tuple[Quantity, ...]:
        """The slices of an observation, each with name, size and unit."""
        return self.env.observation

    @property
    def actions(self) -> Space:
        """The action space."""
        return actions_of(self.env)

    @user_code.report_user_errors
    def reset(self, key: PRNGKeyArray) -> tuple[EnvState, Float[Array, " obs"]]:
        """Start an episode; return (state, observation)."""
        return jax.jit(self.env.reset)(key)

    @user_code.report_user_errors
    def step(
        self, key: PRNGKeyArray, state: EnvState, action: Float[Array, " action"] | Float[np.ndarray, " action"]
    ) -> tuple[EnvState, Step]:
        """Execute an action. Where an episode ends, a new one begins automatically.

        Raises UserError for an action of another shape, or of numbers that the space cannot use.
        """
        space = self.actions
        if not isinstance(action, Tracer):
            value, action = action, numbers("action", action)
            if action.shape != (space.size,) or not space.usable(action, np):
                example = np.asarray(space.spread(4))[0].round(2).tolist()
                advice = f"give an action of shape ({space.size},), as {example}"
                raise UserError(f"action is {format_value(value)}: {advice}")
        return jax.jit(self.env.step)(key, state, action)


@user_code.report_user_errors
def make(name: str | Task, *, scenario: str | None = None, robot: str | None = None, **changes: Any) -> World:
    """Return a world of a task.

    Args:
        name: the task, or its name ("billiards", "navigation", one of an installed package, `package.module:NAME`).
        scenario: a changed world of the task's by name.
        robot: the body that acts (default: the task's own): "anymal" in navigation, "fetch" in arm.
        changes: fields of its configuration, as `cuelearner evaluate TASK --help` lists them under "task options".
    """
    task = (registry.resolve(name) if isinstance(name, str) else name).on(robot)
    return World(task, task.configure(scenario, **changes), scenario)


@user_code.report_user_errors
def from_gymnasium(
    env: str | Any,
    *,
    num_envs: int = 8,
    max_steps: int | None = None,
    cues: str | Sequence[Any] = (),
    observation: Sequence[Any] | None = None,
    units: Mapping[str, str] | None = None,
    processes: int = 0,
    **arguments: Any,
) -> World:
    """Return a world of a Gymnasium environment. `gymnasium:FetchReach-v4` names the same world elsewhere.

    One instance is made here and plays an episode, to see how observations and actions are made up. Training, roll-outs
    and evaluation play as many as they need in processes, each an exact function of its seed and the actions so far.

    Args:
        env: an id of Gymnasium's registry (gymnasium_robotics' included), or a class or function that gives an
            environment when it is called with `arguments`.
        num_envs: environments that step together in training.
        max_steps: an episode is truncated after so many (default: as the environment says, or 1,000).
        cues: words for more and less of each entry of an action, "left,right;up,down" (default: "more,less").
        observation: a name, a number of entries and a unit for each slice of the flattened observation,
            [("gripper", 3, "m", "", "own"), ("goal", 3, "m")] (default: its entries by the names of its space). A
            description, a kind ("own": measured by the robot itself) and degrees between beams may follow.
        units: units of slices by name, in place of `observation`; a reading may shift slices in "m" and "rad".
        processes: number of processes that play (0: one for each processor; 1: this process plays).
        arguments: arguments of the environment.
    """
    from cuelearner_jax.tasks import gymnasium

    world = {"num_envs": num_envs, "max_steps": max_steps, "processes": processes}
    task = gymnasium.task_from(env, arguments, **world, cues=cues, observation=observation, units=units)
    return World(task, task.plain())


@user_code.report_user_errors
def teacher_of(source: World | Any) -> Teacher:
    """Return the teacher of a world, or a teacher that shows what a given policy does."""
    if isinstance(source, World):
        return source.task.make_teacher(source.config, source.env)
    return Teaching(policy_of(source.policy if isinstance(source, Teaching) or hasattr(source, "trained") else source))


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """The configuration of an environment without a task."""


def world_around(env: Environment) -> World:
    """Return an environment without a task as a world without a teacher."""
    start = Preset("as adaptation starts", RunConfig(NoOptions(), scalars=plain_scalars(actions_of(env))))
    body = Body("actor", "who acts", lambda config, split: env)
    about = "an environment without a task"
    return World(Task("environment", about, NoOptions, (body,), presets={PAPER: start}), NoOptions())


def numbers(name: str, value: Any) -> Float[np.ndarray, "..."]:
    """Return numbers of any shape, all finite in single precision."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" and not jnp.issubdtype(array.dtype, jnp.floating):  # NumPy lacks bfloat16's kind
        raise UserError(f"{name} is {format_value(value)}: give an array of real numbers")
    if isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any():
        raise UserError(f"{name} is an array with masked numbers: leave these rows out")
    if not (np.abs(array.astype(np.float64)) <= LARGEST_FLOAT).all():
        raise UserError(f"{name} holds numbers that are not finite (in single precision): leave these rows out")
    return array.astype(np.float32)


def teacher_of_world(value: Any, space: Space) -> Teacher:
    """Return a teacher: the given one, or one that shows what a given policy does itself."""
    # only a `CallablePolicy`, whose module is above this one, has `trained`
    return teaching(value.policy if hasattr(value, "trained") else value, space)
