"""Messages and progress of long work, on standard error."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import IO, Any, cast

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from cuelearner_jax.signals import Interrupted, interruptible

__all__ = ["Interrupted", "abandon", "console", "interruptible", "progress_bars", "watched_by"]


class _StandardError:
    """The current `sys.stderr`. Work goes on if its reader is gone: a closed pipe or terminal."""

    def __getattr__(self, name: str) -> Any:
        return getattr(getattr(sys.stderr, "rich_proxied_file", sys.stderr), name)  # a progress bar wraps the stream

    def write(self, text: str) -> int:
        try:
            self.__getattr__("write")(text)
            self.__getattr__("flush")()
        except OSError:  # else Python would try again to write the rest when it ends, and fail
            abandon(self)
        return len(text)

    def flush(self) -> None:
        """Do nothing: text is flushed when it is written."""


def abandon(stream: Any) -> None:
    """Redirect a stream without a reader to the null device."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


# Text contains the user's words (paths, names of tasks), so none of it is markup.
PLAIN: dict[str, Any] = {"markup": False, "emoji": False, "highlight": False, "soft_wrap": True}
console = Console(file=cast(IO[str], _StandardError()), **PLAIN)


FIRST, EVERY = 1.0, 5.0  # seconds until the first line of progress, and between two
PACE = 24 * 3600.0  # seconds of work from which the time left is estimated; the first stretch, which compiles, is not


@contextmanager
def progress_bars(visible: bool = True) -> Iterator[Progress]:
    """Show progress on standard error: bars on a terminal, lines elsewhere, nothing unless `visible`."""
    if visible and not console.is_terminal:
        yield ProgressLines(console=console, disable=True, speed_estimate_period=PACE)
        return
    name, note = (TextColumn(text, markup=False) for text in ("{task.description:<12}", "{task.fields[note]}"))
    columns = name, BarColumn(), MofNCompleteColumn(), note, TimeRemainingColumn()
    with Progress(*columns, console=console, disable=not visible, speed_estimate_period=PACE) as bars:
        yield bars


class ProgressLines(Progress):
    """Progress as lines, for a file or a pipe: none before `FIRST`, then at most one in `EVERY` seconds."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._next = time.monotonic() + FIRST

    def update(self, task_id: TaskID, **options: Any) -> None:
        """Set the progress of a piece of work, and print a line about it if one is due."""
        super().update(task_id, **options)
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + EVERY
        task = self._tasks[task_id]
        amount = f"{task.completed:,.0f} of {task.total:,.0f}" if task.total else ""
        left = f"about {timedelta(seconds=task.time_remaining)} left" if task.time_remaining else ""
        parts = ", ".join(filter(None, [task.description, amount, task.fields.get("note")]))
        times = ", ".join(filter(None, [f"after {timedelta(seconds=round(task.elapsed or 0))}", left]))
        console.print(f"{parts}; {times}")


def watched_by(bars: Progress) -> Callable[[str], Callable[[int, int], None]]:
    """Return a function that starts a bar for a piece of work and returns the bar's progress callback."""

    def watch(what: str) -> Callable[[int, int], None]:
        bar = bars.add_task(what, total=None, note="")
        return lambda count_so_far, count: bars.update(bar, completed=count_so_far, total=count)

    return watch
