"""`cuelearner train`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

from cuelearner_jax.cli.parsing import check_numbers, out
from cuelearner_jax.cli.shared_options import RunT, Training, asked_of_preset, asking_kind
from cuelearner_jax.runs.grid import LARGEST_SEED, Grid
from cuelearner_jax.studies import train


@dataclass(frozen=True)
class Train(Training[RunT], Generic[RunT]):
    """Train one seed under one kind of guidance."""

    guidance: str = ""
    """Kind of guidance."""
    labels: int = 500
    """Number of labels to ask the teacher for."""
    seed: int = 0
    """Seed of the run."""


OPTIONS = {"train": Train}


def run(arguments: list[str]) -> None:
    """Run the command. Raises what `studies.train.run` raises."""
    task, asked = asked_of_preset(
        arguments,
        "train",
        Train,
        lambda grid: {"guidance": asking_kind(grid.guidance), "labels": grid.labels[0]},
    )
    check_numbers(asked, seed=(0, LARGEST_SEED - 1))
    train.run(asked.order(task, Grid((asked.guidance,), (asked.seed,), (asked.labels,))))
    out.print(asked.done)
