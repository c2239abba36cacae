"""What several commands share of their options: a field is an option, the text below it its help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Generic, TypeVar

import tyro

from cuelearner_jax.config import RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.task import Task

TaskT = TypeVar("TaskT")
Flag = tyro.conf.FlagCreatePairsOff


@dataclass(frozen=True)
class Training(Generic[TaskT]):
    """What train and sweep share."""

    run: Annotated[RunConfig[TaskT], tyro.conf.arg(name="")]
    out: Path
    """Folder for results and checkpoints."""
    resume: Flag[bool] = False
    """Go on with an interrupted run."""
    overwrite: Flag[bool] = False
    """Delete what an earlier run left in the folder."""
    labels_from: Path | None = None
    """Use the labels of this file instead of asking the teacher."""
    tuning: Flag[bool] = False
    """Evaluate on episodes set aside for choosing settings, not on those of reported figures."""
    track: str | None = None
    """Also write curves, means over seeds, for tensorboard or wandb (offline), below the run's folder."""

    def order(self, task: Task, grid: Grid, shard: Shard | None = None) -> Order:
        """What is asked for, of a task and a grid."""
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
        """What is told at the end."""
        return f"done: {self.out} (see it with: cuelearner report {self.out} --out {self.out}/report)"
