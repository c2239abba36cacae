"""`cuelearner train`, and the options that it shares with `cuelearner sweep`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from cuelearner_jax import plugins
from cuelearner_jax.cli.options import (
    Flag,
    Kinds,
    Outside,
    RunParts,
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
from cuelearner_jax.task import QUICKSTART

TrainingT = TypeVar("TrainingT", bound="TrainingOptions")
Settled = Annotated[Any, tyro.conf.Fixed, tyro.conf.Suppress]  # of the order, but no option: set after parsing


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(Outside, RunParts, Order):
    """Options that train and sweep share, and the order that they make."""

    task: Settled = None
    grid: Settled = None
    split: Settled = "validation"
    shard: Settled = None
    config: Annotated[RunConfig[Kinds], unprefixed] = field(default_factory=lambda: RunConfig(Unnamed()))
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

    def train(self, grid: Grid, shard: Shard | None = None) -> None:
        """Train these lanes and print where they lie. Raises what `studies.train.run` raises."""
        train.run(replace(self, grid=grid, shard=shard, split="tuning" if self.tuning else "validation"))
        out.print(f"done: {self.out} (show it by: cuelearner report {self.out} --out {self.out}/report)")


@dataclass(frozen=True, kw_only=True)
class Train(TrainingOptions):
    """Train one seed under one kind of guidance."""

    guidance: str = ""
    """Kind of guidance."""
    labels: int = 500
    """Number of labels to ask the teacher for; 0: the unguided agent."""
    seed: int = 0
    """Seed of the run."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises what `studies.train.run` raises."""
    usual = lambda grid: {"guidance": asking_kind(grid.guidance), "labels": grid.labels[0]}  # noqa: E731
    options, _ = parse_training(arguments, "train", Train, usual)
    options.train(Grid((options.guidance,), (options.seed,), (options.labels,)))


def parse_training(
    arguments: list[str], command: str, kind: type[TrainingT], usual: Callable[[Grid], dict[str, Any]]
) -> tuple[TrainingT, Grid]:
    """Return the options of a training command, for the chosen robot, and the grid of its preset.

    `usual`: from that grid, the default options that are not common to all training commands.
    """
    ahead = look_ahead_of(arguments, command, kind)
    task = task_of(ahead)
    name, preset = preset_of(task, ahead.preset, QUICKSTART)
    request = train.suggested(task, preset)
    grid, config = request.grid, request.config
    for part, table in PARTS.items():
        own = None if (word := getattr(ahead, part)) is None else plugins.resolve(table, word, part)
        if own is not None and own is not type(getattr(config, part)):
            config = replace(config, **{part: own()})
    guides = [guidances.resolve(word) for word in ahead.guidance or grid.guidance]
    kinds = {one.name: config.kinds.get(one.name) or one.config() for one in guides if one.config}
    default = kind(config=replace(config, kinds=kinds), out=Path("runs") / f"{task.name}-{name}", **usual(grid))
    options = parse(kind, arguments, command, default, about(kind, task, preset=QUICKSTART))
    if options.robot is not None and ":" in options.robot:
        raise UserError(f"--robot is {options.robot}, but training takes no folder of a robot: give its name alone")
    return replace(options, task=task.on(options.robot)), grid


def asking_kind(kinds: tuple[str, ...]) -> str:
    """Return the first of the kinds that asks a teacher, or else the first."""
    return next((kind for kind in kinds if guidances.resolve(kind).asks), kinds[0])
