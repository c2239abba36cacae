"""Where a run can be followed while it goes on, beside its own table: one small file a tracker.

Trackers get means over seeds; the table of results stays what reports are made of.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from cuelearner_jax.errors import UserError, closest

# Each a module beside this one with `Tracker(folder, described, step)`, and the package that it needs.
PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb"}
LANE = ("seed", "labels", "step")  # columns that say which row it is


@runtime_checkable
class Tracker(Protocol):
    """Follows one kind of guidance of a run."""

    def log(self, step: int, metrics: dict[str, float]) -> None:
        """Metrics by name, after so many steps of each lane."""
        ...

    def close(self) -> None:
        """Writes what is left."""
        ...


def check(name: str | None) -> None:
    """Raises UserError unless there is such a tracker, and its package is installed (None: no tracker)."""
    if name is None:
        return
    if name not in PACKAGES:
        raise UserError(f"unknown tracker {name!r}{closest(name, PACKAGES)}")
    if find_spec(PACKAGES[name]) is None:
        raise UserError(f"--track {name} needs {PACKAGES[name]}: pip install {PACKAGES[name]}")


@contextmanager
def opened(name: str | None, folder: Path, described: dict[str, Any], step: int) -> Iterator[Tracker | None]:
    """A tracker that writes below a folder, going on after a step; None where none is asked for."""
    if name is None:
        yield None
        return
    tracker = importlib.import_module(f"{__name__}.{name}").Tracker(folder / name, described, step)
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
