"""Evaluation as one request, filled alike by the command line and Python: policies on validation episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from cuelearner_jax.devices import release_programs
from cuelearner_jax.environment import actions_of, view_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import Tell, episodes, ignore_progress, part_of, rollout_lanes
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Common, lanes_in
from cuelearner_jax.runs.trained import POLICIES, Block, PolicySource, blocks_of, make
from cuelearner_jax.task import Task

TaskT = TypeVar("TaskT")

MOST_ENVS = 100_000  # more do not fit into memory
MOST_STEPS = 1_000_000  # per environment
MOST = MOST_ENVS * MOST_STEPS


@dataclass(frozen=True, kw_only=True)
class EvaluateRequest(Generic[TaskT]):
    """A request to evaluate a policy."""

    task: TaskT
    policy: str = "agent"
    """Who acts."""
    guidance: tuple[str, ...] = ()
    """Kinds of guidance of the run to evaluate (default: all)."""
    episodes: int | None = None
    """Number of whole episodes per lane, where the task counts episodes (default: 100)."""
    steps: int | None = None
    """Number of environment steps per lane, instead of episodes (default where the task counts steps: 10,000)."""
    envs: int | None = None
    """Number of environments that share the steps (default: 100)."""
    engine: str | None = None
    """Alternative physics engine of the robot. `mujoco` for anymal is C MuJoCo with a finer step instead of MJX; it
    measures first episodes only."""


class Measured(NamedTuple):
    """A policy's metrics for one guidance and budget."""

    guidance: str
    labels: int
    step: int  # of the policy's training; 0: untrained
    seeds: np.ndarray  # (seeds,)
    metrics: dict[str, np.ndarray]  # each (seeds,)
    each: dict[str, np.ndarray]  # metrics per environment (seeds, envs); NaN where the first episode has not ended
    bound_deg: float | None = None  # bound of a policy folder's lanes, in `unit`
    is_shared: bool = False  # whether all seeds have one policy
    unit: str = "deg"  # of the space of actions

    @property
    def within(self) -> str:
        """The bound with its unit; empty without a bound."""
        return "" if self.bound_deg is None else f"{self.bound_deg:g} {self.unit}"


def amount(task: Task, asked: EvaluateRequest[Any]) -> tuple[int, int]:
    """Return the number of environments and the number of steps that they share.

    Raises UserError for invalid numbers, or steps that cut episodes short.
    """
    longest = None if task.longest is None else task.longest(asked.task)
    if asked.episodes is not None:
        if asked.steps is not None or asked.envs is not None:
            raise UserError("episodes determines environments and steps: leave out steps and envs")
        if longest is None:
            raise UserError(f"{task.name} counts steps, not episodes: give steps in place of episodes")
        if not 1 <= asked.episodes <= MOST_ENVS:
            raise UserError(f"episodes is {asked.episodes}: give a number from 1 to {MOST_ENVS:,}")
        return asked.episodes, asked.episodes * longest
    envs = 100 if asked.envs is None else asked.envs
    if not 1 <= envs <= MOST_ENVS:
        raise UserError(f"envs is {envs}: give a number from 1 to {MOST_ENVS:,}")
    default = 10_000 if longest is None else envs * longest
    steps = default if asked.steps is None else asked.steps
    if steps < 1 or steps % envs:
        raise UserError(f"steps is {steps}: give a positive multiple of envs ({envs})")
    if steps // envs > MOST_STEPS:
        raise UserError(f"steps is {steps}: give at most {MOST_STEPS:,} for each of the environments (envs)")
    task.check_whole(asked.task, envs, steps, "envs", "steps")
    return envs, steps


def run(
    source: PolicySource,
    asked: EvaluateRequest[Any],
    watch: Callable[[str], Tell] = lambda kind: ignore_progress,
    policy: Any = None,
) -> list[Measured]:
    """Return metrics of a policy on validation episodes of a world, for each guidance and budget.

    Args:
        source: the policy's origin.
        asked: the request, whose `task` is the world (a configuration).
        watch: given a kind of guidance, returns the function that reports the progress of its lanes.
        policy: a policy in place of one of the source's; None: use the source's.

    Raises:
        UserError: an invalid request, or a policy that is not available (`PolicySource.check` finds that sooner).
    """
    release_programs()
    task, world, name = source.task, asked.task, asked.policy
    num_envs, steps = amount(task, asked)
    engine, key = task.engine(asked.engine), episodes()
    env = task.environment(world, "validation")
    named = POLICIES[name]
    teacher = task.make_teacher(world, env) if policy is None and named.taught else None
    if policy is not None or not named.kept:
        policy = make(name, source.config, view_of(env), teacher, code=source.code) if policy is None else policy
        none = np.zeros(1, int)
        blocks = [Block("-", none, none, none, 0, Common(policy), none > 0)]
    else:
        blocks = blocks_of(source, name, view_of(env), teacher, tuple(map(guidances.kind_name, asked.guidance)))
    rows, unit = [], actions_of(env).unit.replace("degrees", "deg")
    for block in blocks:
        count, is_shared = len(block.seeds), lanes_in(block.policy) is None
        tell = watch(name if block.guidance == "-" else block.guidance)
        if engine:
            tells = [part_of(tell, lane, count) for lane in range(count)]
            lanes = [engine(block.policy.lane(lane), env, key, num_envs, steps, tells[lane]) for lane in range(count)]
            each = {metric: np.stack([np.asarray(lane[metric], float) for lane in lanes]) for metric in lanes[0]}
            means = {metric: values.mean(-1) for metric, values in each.items()}
        else:
            means, each, _ = rollout_lanes(env, block.policy, key, num_envs, steps, tell)
        place = np.zeros(count, int) if is_shared and not engine else np.arange(count)  # row of each lane
        for bound, budget in sorted(set(zip(block.bounds.tolist(), block.budgets.tolist(), strict=True))):
            own = (block.budgets == budget) & (block.bounds == bound)
            mine, apart = ({metric: np.asarray(of[metric])[place[own]] for metric in of} for of in (means, each))
            bounded = bound or None
            variant = block.guidance, budget, block.step, block.seeds[own]
            rows.append(Measured(*variant, mine, apart, bounded, is_shared, unit))
    return rows
