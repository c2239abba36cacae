"""Where a run can be followed while it goes on, beside its own table: in TensorBoard or Weights & Biases.

Trackers get means over seeds; the table of results stays what reports are made of.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.errors import UserError, suggestion

LANE = ("seed", "labels", "step")  # columns that say which row it is


class TensorBoard:
    """Event files for TensorBoard, by tensorboardX: `tensorboard --logdir RUN_FOLDER`."""

    package = "tensorboardX"

    def __init__(self, folder: Path, described: dict[str, Any], step: int) -> None:
        """Goes on in a folder; what was written past `step` is void."""
        self._writer = importlib.import_module(self.package).SummaryWriter(
            str(folder), purge_step=step + 1 if step else None
        )

    def log(self, step: int, metrics: dict[str, float]) -> None:
        """One point of each curve."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def close(self) -> None:
        """Writes what is left."""
        self._writer.close()


class Wandb:
    """Weights & Biases, offline: nothing leaves the machine before `wandb sync RUN/KIND/wandb/wandb/offline-run-*`."""

    package = "wandb"

    def __init__(self, folder: Path, described: dict[str, Any], step: int) -> None:
        """A run of its own below the folder, named as the folders above say; one that goes on gets another."""
        folder.mkdir(parents=True, exist_ok=True)
        kind, run = folder.parent.name, folder.parent.parent.name
        self._run = importlib.import_module(self.package).init(
            mode="offline",
            dir=str(folder),
            config=described,
            reinit="create_new",
            project="cuelearner",
            group=run,
            name=f"{run} {kind}",
            settings={"silent": True},  # its summary of forty lines would stand between ours
        )

    def log(self, step: int, metrics: dict[str, float]) -> None:
        """One point of each curve."""
        self._run.log(metrics, step=step)

    def close(self) -> None:
        """Writes what is left."""
        self._run.finish()


Tracker = TensorBoard | Wandb
TRACKERS: dict[str, type[Tracker]] = {"tensorboard": TensorBoard, "wandb": Wandb}


def check(name: str | None) -> None:
    """Raises UserError unless there is such a tracker, and its package is installed (None: no tracker)."""
    if name is None:
        return
    if name not in TRACKERS:
        raise UserError(f"unknown tracker {name!r}{suggestion(name, TRACKERS)}")
    if find_spec(package := TRACKERS[name].package) is None:
        raise UserError(f"--track {name} needs {package}: pip install {package}")


@contextmanager
def opened(name: str | None, folder: Path, described: dict[str, Any], step: int) -> Iterator[Tracker | None]:
    """A tracker that writes below a folder, going on after a step; None where none is asked for."""
    if name is None:
        yield None
        return
    tracker = TRACKERS[name](folder / name, described, step)
    try:
        yield tracker
    finally:
        tracker.close()


def means(row: dict[str, Any]) -> dict[str, float]:
    """Means over the seeds of each budget, as "metric/labels_N", of an evaluation's columns; without failed lanes.

    Args:
        row: scalars, or one entry for each lane; "labels" says the lanes' budgets.
    """
    budgets, found = np.asarray(row["labels"]), {}
    for name in row.keys() - set(LANE):
        values = np.broadcast_to(np.asarray(row[name], float), budgets.shape)
        for budget in np.unique(budgets):
            own = values[(budgets == budget) & np.isfinite(values)]
            if len(own):
                found[f"{name}/labels_{budget}"] = float(own.mean())
    return dict(sorted(found.items()))
