"""Training from Python: what `cuelearner sweep` does, with the results in memory and nothing on the disk."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from cuelearner_jax import config as configuration
from cuelearner_jax import user_code
from cuelearner_jax.api import arguments
from cuelearner_jax.api.acting import CallablePolicy
from cuelearner_jax.api.worlds import World, a_world
from cuelearner_jax.devices import SHARED, lane_mesh, place
from cuelearner_jax.environment import view_of
from cuelearner_jax.errors import UserError, closest
from cuelearner_jax.evaluate import SPLITS
from cuelearner_jax.guides import registry
from cuelearner_jax.policies import Agent
from cuelearner_jax.run_config import RunConfig, check
from cuelearner_jax.runs import failures
from cuelearner_jax.runs.grid import LARGEST_SEED, Grid, check_grid
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.runs.memory_report import memory_report
from cuelearner_jax.runs.training import Training, mean_of_finite
from cuelearner_jax.terminal import progress_bars
from cuelearner_jax.types import Teacher


@dataclasses.dataclass(frozen=True)
class Run:
    """What a training has led to. Rows of `results` with `failed` 1 are of lanes that are no longer finite."""

    world: World
    config: RunConfig
    results: pa.Table  # a row a lane and evaluation: guidance, labels, seed, step, wall_s, failed and metrics
    trainings: dict[str, Training]  # by kind of guidance, at their end

    def policy(self, guidance: str | None = None, labels: int | None = None, seed: int | None = None) -> CallablePolicy:
        """One lane's trained agent.

        Args:
            guidance: kind of guidance (default: the last).
            labels: label budget (default: the largest).
            seed: seed (default: the first).

        Raises:
            UserError: there is no such lane.
        """
        labels = arguments.optional(arguments.budget, "labels", labels, 0)
        seed = arguments.optional(arguments.seed, "seed", seed)
        name = list(self.trainings)[-1] if guidance is None else arguments.text("guidance", guidance)
        if name not in self.trainings:
            raise UserError(f"no guidance {name!r} was trained{closest(name, self.trainings)}")
        training = self.trainings[name]
        group = training.group
        budget = int(group.budgets.max()) if labels is None else labels
        wanted = int(group.seeds[0]) if seed is None else seed
        found = np.flatnonzero((group.seeds == wanted) & (group.budgets == budget))
        if not len(found):
            raise UserError(f"no lane with seed {wanted} and {budget} labels was trained")
        params = [block.agent.params for block in training.blocks]
        joined = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves]), *params)
        agents = Agent(joined, self.config.agent_in(group.env), view_of(group.env))
        return CallablePolicy(agents.lane(int(found[0])), self.world.observation)


@user_code.told
def train(
    world: World,
    teacher: Teacher | None = None,
    config: RunConfig | str = "quickstart",
    *,
    guidance: Sequence[str] = (),
    labels: Sequence[int] = (100,),
    seeds: int | Sequence[int] = 8,
    split: str = "validation",
    progress: bool = True,
) -> Run:
    """Trains seeds x label budgets x kinds of guidance, as `cuelearner sweep` does: the same numbers.

    Warns of lanes that stopped being finite: their agents stay as they last were, their rows have no metrics.

    Args:
        world: where.
        teacher: who answers; needed by kinds of guidance that ask.
        config: everything else, or the name of one of the task's presets; its world is the one given.
        guidance: kinds of guidance (default: all that the world can have with what is given).
        labels: label budgets.
        seeds: their number (0, 1, ...), or the seeds.
        split: episodes of the evaluations: "validation", or "tuning" for choosing settings.
        progress: show progress bars on standard error.

    Raises:
        UserError: settings that make no sense, no teacher where one is asked, or too little memory.
    """
    a_world("world", world)
    if arguments.optional(arguments.teacher, "teacher", teacher) is not None:
        user_code.answers_in("teacher", teacher, world.env)
    guidance = [arguments.text("guidance", kind) for kind in arguments.several("guidance", guidance, "kinds")]
    budgets = tuple(arguments.budget("labels", one) for one in arguments.several("labels", labels, "label budgets"))
    arguments.text("split", split, SPLITS)
    arguments.flag("progress", progress)
    run_config = dataclasses.replace(_config(world, config), task=world.config)
    check(run_config)
    world.task.check_evaluations(run_config)
    asked = guidance or registry.possible(world.env, taught=teacher is not None)
    names = tuple(registry.resolve(kind).name for kind in asked)
    grid = Grid(names, _seeds(seeds), budgets)
    check_grid(grid)
    mesh = lane_mesh()
    env = place(mesh, world.env, SHARED)
    kinds = [run_config.guide_in(env, kind) for kind in names]
    asking = [kind.name for kind in kinds if kind.asks]
    if asking and teacher is None:
        raise UserError(f"guidance {asking[0]!r} asks a teacher: give one, for instance teacher_of(world)")
    groups = [LaneGroup(run_config, env, kind, grid) for kind in kinds]
    for group in groups:
        memory_report(group)
    examined, rows, trainings = world.environment(split), [], {}
    with progress_bars(shown=progress) as bars:
        for group in groups:
            training = Training(group, examined, split)
            training.begin()
            bar = bars.add_task(group.guidance.name, total=run_config.schedule.total_steps, note="")
            while not training.done:
                if not training.labelled:
                    asked = bars.add_task(f"{group.guidance.name}: labels", total=group.rounds, note="")
                    for done in training.label_rounds(place(mesh, teacher, SHARED)):
                        bars.update(asked, completed=done)
                for row in training.stretches():
                    rows.append(_table(group, row))
                    bars.update(bar, completed=training.step, note=f"reward {mean_of_finite(row['reward'])}")
            trainings[group.guidance.name] = training
    table = pa.concat_tables(rows, promote_options="permissive")
    failed = failures.summary(table)
    if failed:
        warnings.warn(f"{failed}: leave out the rows with failed = 1", stacklevel=2)
    return Run(world, run_config, table, trainings)


def _seeds(seeds: int | Sequence[int]) -> tuple[int, ...]:
    """Seeds by their number, or one by one."""
    if isinstance(seeds, list | tuple | range | np.ndarray):
        return tuple(arguments.seed("seeds", seed) for seed in arguments.several("seeds", seeds, "seeds"))
    return tuple(range(arguments.whole("seeds", seeds, 1, LARGEST_SEED)))


def _config(world: World, config: RunConfig | str) -> RunConfig:
    if isinstance(config, RunConfig):
        groups = ("sizes", "scalars", "schedule", "agent", "arbiter")
        return dataclasses.replace(
            config, **{name: configuration.settled(getattr(config, name), name) for name in groups}
        )
    presets = world.task.presets
    if not isinstance(config, str):
        raise arguments.refused("config", config, "a RunConfig, or the name of a preset")
    if config not in presets:
        raise UserError(f"config: unknown preset {config!r}{closest(config, presets)}")
    return presets[config].config


def _table(group: LaneGroup, row: dict[str, Any]) -> pa.Table:
    """The columns of one evaluation, with a row for each lane."""
    lanes = len(group.seeds)
    columns = {name: np.broadcast_to(np.asarray(value), (lanes,)) for name, value in row.items()}
    names = pa.array([group.guidance.name] * lanes)
    return pa.table(
        {"guidance": names, **{name: pa.array(values, from_pandas=True) for name, values in columns.items()}}
    )
