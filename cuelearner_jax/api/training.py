"""Training from Python: what `cuelearner sweep` does, with the results in memory and no files written."""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Sequence
from operator import index
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cuelearner_jax import config as configuration
from cuelearner_jax import user_code
from cuelearner_jax.api.policies import CallablePolicy
from cuelearner_jax.api.worlds import World, teacher_of_world
from cuelearner_jax.environment import view_of
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import failures
from cuelearner_jax.runs.grid import Grid, seeds_of
from cuelearner_jax.runs.order import TrainRequest
from cuelearner_jax.runs.policy_sources import best_lane
from cuelearner_jax.runs.training import Training
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage import results as stored
from cuelearner_jax.studies import train as study
from cuelearner_jax.types import Teacher

SEEDS, LABELS = 8, (100,)  # defaults where a configuration is given in place of a preset


@dataclasses.dataclass(frozen=True)
class Run:
    """The results and agents of a training. Rows of `results` with `failed` 1 are lanes that are no longer finite."""

    world: World
    config: RunConfig
    results: pa.Table  # a row a lane and evaluation: guidance, labels, seed, step, wall_s, failed and metrics
    trainings: dict[str, Training]  # the trained lanes, by kind of guidance

    def policy(self, guidance: str | None = None, labels: int | None = None, seed: int | None = None) -> CallablePolicy:
        """Return one lane's trained agent: that of the best last reward among those that fit, which is printed."""
        if guidance is not None and guidance not in self.trainings:
            raise UserError(f"no guidance {guidance!r} was trained{suggestion(guidance, self.trainings)}")
        name, budget, seeds = best_lane(self.results, (guidance, labels, () if seed is None else (seed,)))
        training = self.trainings[name or [*self.trainings][-1]]
        group = training.group
        if not len(lanes := np.flatnonzero((group.budgets == budget) & np.isin(group.seeds, seeds))):
            raise UserError(f"no lane with seed {seed} and {labels} labels was trained")
        agent = training.policies(view_of(group.env)).lane(int(lanes[0]))
        lane = {"guidance": name, "labels": budget, "seed": seeds[0]}
        world = self.world
        return CallablePolicy(agent, world.observation, False, self.config, world.actions, world, lane)


@user_code.report_user_errors
def train(
    world: World,
    teacher: Teacher | Any = None,
    config: RunConfig | str = "quickstart",
    *,
    guidance: str | Sequence[str] = (),
    labels: int | Sequence[int] | str | os.PathLike[str] | None = None,
    seeds: int | Sequence[int] | None = None,
    split: str = "validation",
    progress: bool = True,
) -> Run:
    """Train seeds x label budgets x kinds of guidance, as `cuelearner sweep` does, with the same numbers.

    Arguments that are left out are the preset's. Lanes that stop being finite raise a warning: their agents keep their
    last finite state, and their rows have no metrics.

    Args:
        world: the world to train in.
        teacher: a teacher (a function of observations, or another policy, teaches what it does); needed by kinds of
            guidance that ask, unless a label file answers.
        config: everything else, or the name of one of the task's presets; its world is the one given.
        guidance: kinds of guidance (default: the preset's, or all, as far as the world can have them).
        labels: label budgets, or a label file in place of the teacher, with as many as its shortest seed has (default:
            the preset's budgets; with a configuration, 100).
        seeds: their number, from the preset's first on, or the seeds (default: the preset's; with a configuration, 8).
        split: episodes of the evaluations: "validation", or "tuning" for choosing settings.
        progress: show progress bars on standard error.
    """
    if teacher is not None:
        teacher = teacher_of_world(teacher, world.actions)
    file = Path(labels) if isinstance(labels, str | os.PathLike) else None
    task, possible = world.task, guidances.possible(world.env, taught=teacher is not None or file is not None)
    if isinstance(config, RunConfig):
        groups = ("sizes", "scalars", "schedule", "agent", "arbiter")
        settings = {name: configuration.normalize_options(getattr(config, name), name) for name in groups}
        config, usual = dataclasses.replace(config, **settings), Grid(possible, tuple(range(SEEDS)), LABELS)
    elif config in task.presets:
        usual = study.suggested(task, task.presets[config]).grid
        config = task.presets[config].config
    else:
        raise UserError(f"config: unknown preset {config!r}{suggestion(config, task.presets)}")
    if isinstance(labels, str | os.PathLike):
        labels = (label_files.read(Path(labels)).budget,)
    seeds = usual.seeds if seeds is None else seeds
    own = seeds_of(usual.seeds[0], int(seeds)) if isinstance(seeds, int | np.integer) else tuple(map(index, seeds))
    labels = (labels,) if isinstance(labels, int | np.integer) else labels
    own_kinds = (guidance,) if isinstance(guidance, str) else tuple(guidance)
    kinds = own_kinds or tuple(kind for kind in usual.guidance if kind in possible)
    grid = Grid(kinds, own, usual.labels if labels is None else tuple(map(index, labels)))
    config = dataclasses.replace(config, task=world.config)
    request = TrainRequest(task, config, grid, labels_from=file, split=split)
    results, trainings = study.in_memory(request, world.env, world.environment(split), teacher, progress)
    if failed := failures.summary(results):
        warnings.warn(f"{failed}: leave out the rows with failed = 1", stacklevel=2)
    return Run(world, config, results, trainings)


@user_code.report_user_errors
def read_run(folder: str | os.PathLike[str]) -> pa.Table:
    """Return recorded results as one table, with a row a lane and evaluation.

    `run.to_pandas()` is a data frame, where pandas is installed. Each column's field holds its meaning, as
    `run.field("reward").metadata[b"description"]`. `folder`: of a run, finished or not, of a sweep in pieces, or of
    several runs; else UserError.
    """
    return stored.read(folder)
