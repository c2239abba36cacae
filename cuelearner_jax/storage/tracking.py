"""Trackers for following a run while it trains: TensorBoard or Weights & Biases.

Trackers get means over seeds; reports are made from the results table alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.errors import UserError, suggestion

PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb"}  # of each tracker
LANE = ("seed", "labels", "step")  # columns that identify a row

Log = Callable[[int, dict[str, float]], None]  # step, metrics: add one point to each curve


def check(name: str | None) -> None:
    """Raise UserError unless the tracker is known and its package installed (None: no tracker)."""
    if name is None:
        return
    if name not in PACKAGES:
        raise UserError(f"unknown tracker {name!r}{suggestion(name, PACKAGES)}")
    if find_spec(package := PACKAGES[name]) is None:
        raise UserError(f"--track {name} needs {package}: pip install {package}")


@contextmanager
def open_tracker(name: str | None, folder: Path, contents: dict[str, Any], step: int) -> Iterator[Log | None]:
    """Open a tracker in a kind's folder of a run, continuing after `step`; None without a name.

    TensorBoard discards points after `step`. Weights & Biases begins a new offline run, with config.json's `contents`;
    nothing is uploaded before `wandb sync`.
    """
    place = folder / name if name else folder
    if name == "tensorboard":
        with import_module("tensorboardX").SummaryWriter(str(place), purge_step=step + 1 if step else None) as writer:

            def log(step: int, metrics: dict[str, float]) -> None:
                for metric, value in metrics.items():
                    writer.add_scalar(metric, value, step)
                writer.flush()

            yield log
    elif name == "wandb":
        place.mkdir(parents=True, exist_ok=True)
        kind, run = folder.name, folder.parent.name
        where = {"dir": str(place), "project": "cuelearner", "group": run, "name": f"{run} {kind}"}
        # Its summary of forty lines would interrupt the run's own output.
        how = {"mode": "offline", "reinit": "create_new", "settings": {"silent": True}}
        tracker = import_module("wandb").init(config=contents, **where, **how)
        try:
            yield lambda step, metrics: tracker.log(metrics, step=step)
        finally:
            tracker.finish()
    else:
        yield None


def means(row: dict[str, Any]) -> dict[str, float]:
    """Return means of an evaluation over the seeds of each budget ("metric/labels_N"), without failed lanes."""
    budgets, result = np.asarray(row["labels"]), {}
    for name in sorted(name for name in row.keys() - set(LANE) if np.ndim(row[name]) < 2):
        values = np.broadcast_to(np.asarray(row[name], float), budgets.shape)
        for budget in np.unique(budgets):
            if len(own := values[(budgets == budget) & np.isfinite(values)]):
                result[f"{name}/labels_{budget}"] = float(own.mean())
    return result
