"""`cuelearner sweep`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic

from cuelearner_jax.cli.parsing import out
from cuelearner_jax.cli.shared_options import RunT, Training, asked_of_preset
from cuelearner_jax.runs.grid import Grid, seeds_of
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.studies import train


@dataclass(frozen=True)
class Sweep(Training[RunT], Generic[RunT]):
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


OPTIONS = {"sweep": Sweep}


def run(arguments: list[str]) -> None:
    """Run the command. Raises what `studies.train.run` raises."""
    task, asked = asked_of_preset(arguments, "sweep", Sweep, _options)
    grid = Grid(asked.guidance, seeds_of(asked.first_seed, asked.seeds), asked.labels)
    shard = Shard.parse(asked.shard) if asked.shard else None
    train.run(asked.order(task, grid, shard))
    out.print(asked.done)


def _options(grid: Grid) -> dict[str, Any]:
    """Return the options of what a preset compares."""
    seeds = {"seeds": len(grid.seeds), "first_seed": grid.seeds[0]}
    return {"guidance": grid.guidance, "labels": grid.labels, **seeds}
