"""`cuelearner train`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Generic

from cuelearner_jax.cli.parsing import about, out, parse, preset_of, task_of
from cuelearner_jax.cli.shared_options import (
    RunT,
    Training,
    asking_kind,
    parts_of,
    preset_kinds,
)
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import sweep
from cuelearner_jax.runs.grid import LARGEST_SEED, Grid


@dataclass(frozen=True)
class Train(Training[RunT], Generic[RunT]):
    """Train one seed under one kind of guidance."""

    guidance: str = ""
    """Kind of guidance, see above."""
    labels: int = 500
    """Labels that the teacher is asked for."""
    seed: int = 0
    """Seed."""


OPTIONS = {"train": Train}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises what `sweep.run` raises."""
    task, rest = task_of(arguments, "train", Train)
    name, preset, rest = preset_of(task, rest)
    kinds = preset_kinds(task, preset)
    config, run_type, rest = parts_of(preset.config, rest, kinds)
    kind = Train[run_type]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(
        config,
        out=Path("runs") / f"{task.name}-{name}",
        guidance=asking_kind(kinds),
        labels=preset.labels[0],
    )
    asked = parse(kind, rest, f"train {task.name}", default, about(Train, task))
    if not 0 <= asked.seed < LARGEST_SEED:
        raise UserError(f"--seed is {asked.seed}: give a number from 0 to {LARGEST_SEED - 1}")
    sweep.run(asked.order(task, Grid((asked.guidance,), (asked.seed,), (asked.labels,))))
    out.print(asked.done)
