"""`cuelearner sweep`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cuelearner_jax.cli.options import out
from cuelearner_jax.cli.train import Training, task_and_options
from cuelearner_jax.runs.grid import Grid, seeds_of
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.studies import train


@dataclass(frozen=True, kw_only=True)
class Sweep(Training):
    """Train seeds x label budgets x kinds of guidance in one process."""

    guidance: tuple[str, ...] = ()
    """Kinds of guidance."""
    labels: tuple[int, ...] = (500,)
    """Label budgets; guidance without labels runs once per seed."""
    seeds: int = 5
    """Number of seeds."""
    first_seed: int = 0
    """First seed; the others count up from it."""
    shard: str | None = None
    """Run only shard i of n, given as i/n: its share of the seeds, in a folder of its own below --out. An interrupted
    shard is continued."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises what `studies.train.run` raises."""
    task, options = task_and_options(arguments, "sweep", Sweep, _of_grid)
    grid = Grid(options.guidance, seeds_of(options.first_seed, options.seeds), options.labels)
    shard = Shard.parse(options.shard) if options.shard else None
    train.run(options.order(task, grid, shard))
    out.print(options.done)


def _of_grid(grid: Grid) -> dict[str, Any]:
    """Return the options of what a preset compares."""
    seeds = {"seeds": len(grid.seeds), "first_seed": grid.seeds[0]}
    return {"guidance": grid.guidance, "labels": grid.labels, **seeds}
