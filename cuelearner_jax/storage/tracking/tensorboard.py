"""Event files for TensorBoard, by tensorboardX: `tensorboard --logdir RUN_FOLDER`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tensorboardX import SummaryWriter


class Tracker:
    """See `tracking.Tracker`."""

    def __init__(self, folder: Path, described: dict[str, Any], step: int) -> None:
        """Goes on in a folder; what was written past `step` is void."""
        self._writer = SummaryWriter(str(folder), purge_step=step + 1 if step else None)

    def log(self, step: int, metrics: dict[str, float]) -> None:
        """One point of each curve."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def close(self) -> None:
        """Writes what is left."""
        self._writer.close()
