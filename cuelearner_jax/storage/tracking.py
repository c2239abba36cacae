"""Trackers for following a run while it trains: TensorBoard or Weights & Biases.

Trackers get means over seeds; reports are made from the results table alone.
"""

from __future__ import annotations

import importlib
from contextlib import AbstractContextManager, closing, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.errors import UserError, suggestion

LANE = ("seed", "labels", "step")  # columns that identify a row


class TensorBoard:
    """Event files for TensorBoard, written by tensorboardX: `tensorboard --logdir RUN_FOLDER`."""

    package = "tensorboardX"

    def __init__(self, folder: Path, contents: dict[str, Any], step: int) -> None:
        """Continue in a folder; points written after `step` are discarded."""
        writer = importlib.import_module(self.package).SummaryWriter
        self._writer = writer(str(folder), purge_step=step + 1 if step else None)
        self.close = self._writer.close

    def log(self, step: int, metrics: dict[str, float]) -> None:
        """Log one point of each curve."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()


class Wandb:
    """Weights & Biases offline; nothing is uploaded before `wandb sync RUN/KIND/wandb/wandb/offline-run-*`."""

    package = "wandb"

    def __init__(self, folder: Path, contents: dict[str, Any], step: int) -> None:
        """Start a wandb run below the folder, named after the folders above; a resumed run gets a new one."""
        folder.mkdir(parents=True, exist_ok=True)
        kind, run = folder.parent.name, folder.parent.parent.name
        self._run = importlib.import_module(self.package).init(
            **{"mode": "offline", "reinit": "create_new", "project": "cuelearner", "config": contents},
            **{"dir": str(folder), "group": run, "name": f"{run} {kind}"},
            settings={"silent": True},  # its summary of forty lines would interrupt our output
        )
        self.close = self._run.finish

    def log(self, step: int, metrics: dict[str, float]) -> None:
        """Log one point of each curve."""
        self._run.log(metrics, step=step)


Tracker = TensorBoard | Wandb
TRACKERS: dict[str, type[Tracker]] = {"tensorboard": TensorBoard, "wandb": Wandb}


def check(name: str | None) -> None:
    """Raise UserError unless the tracker is known and its package installed (None: no tracker)."""
    if name is None:
        return
    if name not in TRACKERS:
        raise UserError(f"unknown tracker {name!r}{suggestion(name, TRACKERS)}")
    if find_spec(package := TRACKERS[name].package) is None:
        raise UserError(f"--track {name} needs {package}: pip install {package}")


def open_tracker(
    name: str | None, folder: Path, contents: dict[str, Any], step: int
) -> AbstractContextManager[Tracker | None]:
    """Open a tracker that writes below a folder, continuing after `step`; None without a name."""
    return nullcontext() if name is None else closing(TRACKERS[name](folder / name, contents, step))


def means(row: dict[str, Any]) -> dict[str, float]:
    """Return means of an evaluation over the seeds of each budget ("metric/labels_N"), without failed lanes."""
    budgets, result = np.asarray(row["labels"]), {}
    for name in (name for name in row.keys() - set(LANE) if np.ndim(row[name]) < 2):
        values = np.broadcast_to(np.asarray(row[name], float), budgets.shape)
        for budget in np.unique(budgets):
            own = values[(budgets == budget) & np.isfinite(values)]
            if len(own):
                result[f"{name}/labels_{budget}"] = float(own.mean())
    return dict(sorted(result.items()))
