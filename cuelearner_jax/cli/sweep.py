"""`cuelearner sweep`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from cuelearner_jax.cli.train import TrainingOptions, parse_training, train_each
from cuelearner_jax.runs.grid import Grid, parse_seeds
from cuelearner_jax.runs.shards import Shard


@dataclass(frozen=True, kw_only=True)
class Sweep(TrainingOptions):
    """Train seeds x label budgets x kinds of guidance in one process.

    A number may have several values, as --scalars.eps-deg 2 5. Each combination of such values has a folder of its own
    below --out; another value of --scalars compiles nothing."""

    guidance: tuple[str, ...] = ()
    """Kinds of guidance."""
    labels: tuple[int, ...] = (500,)
    """Label budgets, 0 for the unguided agent; guidance without labels runs once per seed."""
    seeds: str = "5"
    """Number of seeds, from the preset's first seed on, or a range such as 0:16, without its end."""
    chosen_shard: Annotated[str | None, tyro.conf.arg(name="shard")] = None
    """Run only shard i of n, given as i/n: its share of the seeds, in a folder of its own below --out. An interrupted
    shard is continued."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises what `studies.train.run` raises."""
    seeds_of = lambda grid: f"{grid.seeds[0]}:{grid.seeds[-1] + 1}"  # noqa: E731
    usual = lambda grid: {"guidance": grid.guidance, "labels": grid.labels, "seeds": seeds_of(grid)}  # noqa: E731
    each, preset = parse_training(arguments, "sweep", Sweep, usual)
    options = each[0]
    grid = Grid(options.guidance, parse_seeds(options.seeds, preset.seeds[0]), options.labels)
    train_each(each, grid, Shard.parse(options.chosen_shard) if options.chosen_shard else None)
