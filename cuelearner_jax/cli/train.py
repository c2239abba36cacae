"""`cuelearner train`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Generic

from cuelearner_jax.cli.parsing import about, out, parse, preset_of, task_of
from cuelearner_jax.cli.shared_options import TaskT, Training
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import sweep
from cuelearner_jax.runs.grid import LARGEST_SEED, Grid
from cuelearner_jax.studies.train import asking_kind, preset_kinds


@dataclass(frozen=True)
class Train(Training[TaskT], Generic[TaskT]):
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
    kind = Train[task.config]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(
        preset.config,
        out=Path("runs") / f"{task.name}-{name}",
        guidance=asking_kind(preset_kinds(task, preset)),
        labels=preset.labels[0],
    )
    asked = parse(kind, rest, f"train {task.name}", default, about(Train, task))
    if not 0 <= asked.seed < LARGEST_SEED:
        raise UserError(f"--seed is {asked.seed}: give a number from 0 to {LARGEST_SEED - 1}")
    sweep.run(asked.order(task, Grid((asked.guidance,), (asked.seed,), (asked.labels,))))
    out.print(asked.done)
