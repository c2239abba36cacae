"""Policies by name: of a trained run's lanes, or of a task alone; evaluated and recorded."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cuelearner_jax.config import RunConfig, to_json
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError, closest
from cuelearner_jax.evaluate import (
    Policy,
    agent_policy,
    corrected_policy,
    each_lane,
    episodes,
    guided_policy,
    heuristic_policy,
    rollout,
    teacher_policy,
    uniform_policy,
)
from cuelearner_jax.guidance import registry as guidances
from cuelearner_jax.records import results
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.lanes import Group, restore_policies
from cuelearner_jax.task import Rollout, Task, shape_of
from cuelearner_jax.types import Guidance, Teacher

# The agent; guidance of uniform actions; guidance of the agent's actions; the teacher's own corrections of them.
TRAINED = ("agent", "guide", "guided", "corrected")
UNTRAINED = ("teacher", "heuristic", "uniform")
TAUGHT = ("teacher", "corrected")  # these ask the teacher


@dataclass(frozen=True)
class Subject:
    """What evaluate and render work on: a run folder, or a task alone."""

    task: Task
    config: RunConfig
    grid: Grid | None
    folder: Path

    def on(self, robot: str | None) -> Subject:
        """The same with another robot of the task's (None: its own). Raises UserError if it has no such robot."""
        return replace(self, task=self.task.on(robot))

    def check(self, policy: str, changed: Any) -> None:
        """Raises UserError unless the policy can be had and acts in the changed world."""
        known = (TRAINED if self.grid else ()) + UNTRAINED
        if policy not in TRAINED + UNTRAINED:
            raise UserError(f"unknown policy {policy!r}{closest(policy, TRAINED + UNTRAINED)}")
        if policy not in known:
            raise UserError(f"policy {policy!r} needs a trained run: give a run folder, or one of {', '.join(known)}")
        before, after = (shape_of(self.task, world).obs_size for world in (self.config.task, changed))
        if before != after:
            raise UserError(f"the run's observations have {before} entries, this world's {after}: keep its structure")


@dataclass(frozen=True)
class Trained:
    """The lanes of one kind of guidance, as their newest checkpoint has them."""

    guidance: Guidance
    seeds: np.ndarray  # (lanes,)
    budgets: np.ndarray  # (lanes,)
    policies: Any  # {"params", "guidance"}, leading axis: lanes
    step: int


def load_lanes(subject: Subject, kinds: tuple[str, ...]) -> list[Trained]:
    """The lanes of a run's kinds of guidance (none named: all). Raises UserError for a kind the run does not have."""
    assert subject.grid is not None  # Subject.check has seen to it
    env = shape_of(subject.task, subject.config.task)
    loaded = []
    for kind in kinds or subject.grid.guidance:
        if kind not in subject.grid.guidance:
            raise UserError(
                f"{subject.folder} has no guidance {kind!r}: choose among {', '.join(subject.grid.guidance)}"
            )
        made = guidances.make(kind, subject.config.sizes, env.obs_size)
        group = Group(subject.config, env, made, subject.grid)
        policies, step = restore_policies(group, subject.folder / kind)
        loaded.append(Trained(group.guidance, group.seeds, group.budgets, policies, step))
    return loaded


def trained_policy(
    name: str, lanes: Trained, lane: Any, config: RunConfig, env: Environment, teacher: Teacher | None
) -> Policy:
    """One lane's policy. `lane` is its entry of `lanes.policies`."""
    agent = agent_policy(config.sizes, lane["params"])
    if name == "agent":
        return agent
    if teacher is not None:
        return corrected_policy(agent, teacher, config.scalars)
    base = uniform_policy() if name == "guide" else agent
    return guided_policy(base, lanes.guidance, lane["guidance"], env, config.scalars)


def untrained_policy(name: str, env: Environment, teacher: Teacher | None) -> Policy:
    """A policy that needs no run: the task's teacher or heuristic, or chance."""
    if teacher is not None:
        return teacher_policy(teacher)
    return heuristic_policy(env) if name == "heuristic" else uniform_policy()


class Measured(NamedTuple):
    """A policy's metrics under one guidance and budget."""

    guidance: str
    labels: int
    step: int
    seeds: np.ndarray  # (seeds,)
    metrics: dict[str, np.ndarray]  # each (seeds,)


def evaluate(
    subject: Subject,
    world: Any,
    name: str,
    kinds: tuple[str, ...],
    num_envs: int,
    steps: int,
    engine: Rollout | None = None,
) -> list[Measured]:
    """Metrics of a policy on validation episodes of a world (a task configuration), for each guidance and budget.

    `engine` is a roll-out in other physics (`task.Body.engines`); without one the environment's own are used.
    """
    env = subject.task.environment(world, "validation")
    key = episodes()
    teacher = subject.task.make_teacher(world, env) if name in TAUGHT else None
    if name in UNTRAINED:

        def measure_it(env: Environment, teacher: Teacher | None) -> dict[str, Any]:
            return (engine or rollout)(untrained_policy(name, env, teacher), env, key, num_envs, steps)

        # As arguments: what is closed over becomes a constant of the program.
        found = (measure_it if engine else jax.jit(measure_it))(env, teacher)
        metrics = {metric: np.asarray(value)[None] for metric, value in found.items()}
        return [Measured("-", 0, 0, np.zeros(1, int), metrics)]
    rows = []
    for lanes in load_lanes(subject, kinds):

        def measure(env: Environment, teacher: Teacher | None, policies: Any, lanes: Trained = lanes) -> Any:
            def one(lane: Any) -> dict[str, jax.Array]:
                policy = trained_policy(name, lanes, lane, subject.config, env, teacher)
                return (engine or rollout)(policy, env, key, num_envs, steps)

            return _one_by_one(one, policies) if engine else each_lane(one, policies)

        found = (measure if engine else jax.jit(measure))(env, teacher, lanes.policies)
        found = {metric: np.asarray(values) for metric, values in found.items()}
        for budget in np.unique(lanes.budgets):
            own = lanes.budgets == budget
            metrics = {metric: values[own] for metric, values in found.items()}
            rows.append(Measured(lanes.guidance.name, int(budget), lanes.step, lanes.seeds[own], metrics))
    return rows


def _one_by_one(one: Callable[[Any], dict[str, Any]], lanes: Any) -> dict[str, np.ndarray]:
    """`each_lane` for what can't be compiled."""
    count = jax.tree.leaves(lanes)[0].shape[0]
    found = [one(jax.tree.map(lambda leaf, number=number: leaf[number], lanes)) for number in range(count)]
    return {name: np.stack([measured[name] for measured in found]) for name in found[0]}


def one_policy(
    subject: Subject, env: Environment, world: Any, name: str, kind: str | None, labels: int | None, seed: int | None
) -> Policy:
    """A single policy: of one lane of a run, or of the task. Raises UserError if the run has no such lane."""
    teacher = subject.task.make_teacher(world, env) if name in TAUGHT else None
    if name in UNTRAINED:
        return untrained_policy(name, env, teacher)
    assert subject.grid is not None  # Subject.check has seen to it
    lanes = load_lanes(subject, (kind or subject.grid.guidance[-1],))[0]
    budget = int(lanes.budgets.max()) if labels is None else labels
    seed = int(lanes.seeds[0]) if seed is None else seed
    index = np.flatnonzero((lanes.seeds == seed) & (lanes.budgets == budget))
    if not len(index):
        raise UserError(
            f"no lane with seed {seed} and {budget} labels: the run has seeds {_listed(lanes.seeds)} "
            f"and labels {_listed(lanes.budgets)}"
        )
    lane = jax.tree.map(lambda leaf: leaf[index[0]], lanes.policies)
    return trained_policy(name, lanes, lane, subject.config, env, teacher)


def _listed(values: np.ndarray) -> str:
    known = np.unique(values)
    if len(known) > 4 and known[-1] - known[0] == len(known) - 1:
        return f"{known[0]} to {known[-1]}"
    return ", ".join(str(value) for value in known)


def write(
    path: Path,
    subject: Subject,
    world: Any,
    policy: str,
    num_envs: int,
    steps: int,
    measured: list[Measured],
    body: dict[str, str],
) -> None:
    """Measurements as JSON, with the world, the body if it is not the task's own, and where the numbers come from."""
    rows = [
        {
            "guidance": row.guidance,
            "labels": row.labels,
            "trained_steps": row.step,
            "seeds": row.seeds.tolist(),
            **{metric: values.tolist() for metric, values in row.metrics.items()},
        }
        for row in measured
    ]
    contents = {
        "subject": subject.folder.name,
        "world": {"name": subject.task.name, **to_json(world)},
        "policy": policy,
        **body,
        "envs": num_envs,
        "steps": steps,
        **results.provenance(),
        "rows": rows,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(contents, indent=1) + "\n")
