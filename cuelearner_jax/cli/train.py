"""`cuelearner train`, and the options that it shares with `cuelearner sweep`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

from cuelearner_jax import plugins
from cuelearner_jax.cli.options import (
    Flag,
    Kinds,
    Outside,
    Parts,
    Unnamed,
    about,
    look_ahead_of,
    out,
    parse,
    unprefixed,
)
from cuelearner_jax.cli.sources import preset_of, task_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.run_config import PARTS, RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.studies import train
from cuelearner_jax.task import QUICKSTART, Task

TrainingT = TypeVar("TrainingT", bound="Training")


@dataclass(frozen=True, kw_only=True)
class Training(Outside, Parts):
    """Options that train and sweep share."""

    run: Annotated[RunConfig[Any, Any, Any, Kinds], unprefixed] = field(default_factory=lambda: RunConfig(Unnamed()))
    out: Path = Path("runs/NAME")
    """Folder for results and checkpoints."""
    resume: Flag[bool] = False
    """Continue an interrupted run."""
    overwrite: Flag[bool] = False
    """Delete an earlier run in the folder."""
    labels_from: Path | None = None
    """Label file to use instead of asking the teacher."""
    tuning: Flag[bool] = False
    """Evaluate on the tuning episodes, which are for choosing settings, not on the validation episodes."""
    robot: str | None = None
    """Another robot of the task, which acts in training and in its evaluations (default: the task's own)."""
    track: str | None = None
    """Tracker that also gets the curves, as means over seeds: tensorboard or wandb (offline), below the run's
    folder."""

    def order(self, task: Task, grid: Grid, shard: Shard | None = None) -> Order:
        """Return the order to train a grid of a task."""
        return Order(
            task,
            self.run,
            grid,
            self.out,
            resume=self.resume,
            overwrite=self.overwrite,
            labels_from=self.labels_from,
            shard=shard,
            split="tuning" if self.tuning else "validation",
            track=self.track,
        )

    @property
    def done(self) -> str:
        """The line printed at the end."""
        return f"done: {self.out} (show it by: cuelearner report {self.out} --out {self.out}/report)"


@dataclass(frozen=True, kw_only=True)
class Train(Training):
    """Train one seed under one kind of guidance."""

    guidance: str = ""
    """Kind of guidance."""
    labels: int = 500
    """Number of labels to ask the teacher for."""
    seed: int = 0
    """Seed of the run."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises what `studies.train.run` raises."""
    task, options = task_and_options(
        arguments, "train", Train, lambda grid: {"guidance": asking_kind(grid.guidance), "labels": grid.labels[0]}
    )
    train.run(options.order(task, Grid((options.guidance,), (options.seed,), (options.labels,))))
    out.print(options.done)


def task_and_options(
    arguments: list[str], command: str, kind: type[TrainingT], of_grid: Callable[[Grid], dict[str, Any]]
) -> tuple[Task, TrainingT]:
    """Return the task and the options of a training command. Raises UserError for choices that do not exist.

    `of_grid` returns defaults from what the preset compares.
    """
    ahead = look_ahead_of(arguments, command, kind)
    task = task_of(ahead)
    name, preset = preset_of(task, ahead.preset, QUICKSTART)
    request = train.suggested(task, preset)
    config = request.config
    for part, table in PARTS.items():
        chosen = None if (word := getattr(ahead, part)) is None else plugins.resolve(table, word, part)
        if chosen is not None and chosen is not type(getattr(config, part)):
            config = replace(config, **{part: chosen()})
    used = [guidances.resolve(word) for word in ahead.guidance or request.grid.guidance]
    kinds = {one.name: config.kinds.get(one.name) or one.config() for one in used if one.config}
    default = kind(run=replace(config, kinds=kinds), out=Path("runs") / f"{task.name}-{name}", **of_grid(request.grid))
    options = parse(kind, arguments, command, default, about(kind, task, preset=QUICKSTART))
    if options.robot is not None and ":" in options.robot:
        raise UserError(f"--robot is {options.robot}, but training takes no folder of a robot: give its name alone")
    return task.on(options.robot), options


def asking_kind(kinds: tuple[str, ...]) -> str:
    """Return the first of the kinds that asks a teacher, or else the first."""
    asking = [kind for kind in kinds if guidances.resolve(kind).asks]
    return (asking or list(kinds))[0]
