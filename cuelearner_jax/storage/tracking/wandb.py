"""Weights & Biases, offline: nothing leaves the machine before `wandb sync RUN/KIND/wandb/wandb/offline-run-*`."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

wandb: Any = importlib.import_module("wandb")  # the package, whose name this file has too; it need not be there


class Tracker:
    """See `tracking.Tracker`."""

    def __init__(self, folder: Path, described: dict[str, Any], step: int) -> None:
        """A run of its own below the folder, named as the folders above say; one that goes on gets another."""
        folder.mkdir(parents=True, exist_ok=True)
        kind, run = folder.parent.name, folder.parent.parent.name
        self._run = wandb.init(
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
