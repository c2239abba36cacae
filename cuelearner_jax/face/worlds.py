"""Worlds and teachers by name."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.actions import Actions
from cuelearner_jax.environment import Environment, Quantity, actions_of
from cuelearner_jax.errors import UserError, closest
from cuelearner_jax.policies import Teaching
from cuelearner_jax.task import Task
from cuelearner_jax.tasks import registry
from cuelearner_jax.types import EnvState, Policy, Step, Teacher


@dataclasses.dataclass(frozen=True)
class World:
    """A task in one configuration: an environment for training, others for validation, and who can teach in it."""

    task: Task
    config: Any

    @cached_property
    def env(self) -> Environment:
        """The environment that agents train in: a pytree, see `environment.Environment`."""
        return self.environment("training")

    def environment(self, split: str) -> Environment:
        """That of a split: "training", "tuning" or "validation"."""
        return self.task.environment(self.config, split)

    @property
    def observation(self) -> tuple[Quantity, ...]:
        """The slices of an observation, each with name, size and unit."""
        return self.env.observation

    @property
    def actions(self) -> Actions:
        """The action space."""
        return actions_of(self.env)

    def reset(self, key: PRNGKeyArray) -> tuple[EnvState, Float[Array, " obs"]]:
        """Starts an episode: (state, observation)."""
        return jax.jit(self.env.reset)(key)

    def step(
        self, key: PRNGKeyArray, state: EnvState, action: Float[Array, " action"] | Float[np.ndarray, " action"]
    ) -> tuple[EnvState, Step]:
        """Executes an action; a new episode begins by itself where one ends."""
        return jax.jit(self.env.step)(key, state, action)


def make(name: str | Task, *, scenario: str | None = None, robot: str | None = None, **changes: Any) -> World:
    """A world of a task.

    Args:
        name: of the task ("billiards", "navigation", one of an installed package, `package.module:NAME`), or the task.
        scenario: a changed world of the task's by name.
        robot: what acts there (default: the task's own), "anymal" in navigation, "pooltool" in billiards.
        changes: fields of its configuration, as `cuelearner evaluate TASK --help` lists them under "task options".

    Raises:
        UserError: no such task, scenario, robot or field.
    """
    task = (registry.resolve(name) if isinstance(name, str) else name).on(robot)
    config = task.config()
    if scenario is not None:
        config = task.scenario(scenario).applied(config)
    known = [field.name for field in dataclasses.fields(config)]
    for field in changes:
        if field not in known:
            raise UserError(f"{task.name} has no field {field!r}{closest(field, known)}")
    return World(task, dataclasses.replace(config, **changes))


def teacher_of(source: World | Policy) -> Teacher:
    """Who teaches: in a world its task's own teacher, of a policy (a finished agent, say) that policy.

    Raises:
        UserError: the task has no teacher, or it cannot be had.
    """
    if isinstance(source, World):
        return source.task.make_teacher(source.config, source.env)
    return Teaching(source)
