"""Messages and progress of long work, on standard error."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any, cast

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from cuelearner_jax.signals import Interrupted, interruptible

__all__ = ["Interrupted", "abandon", "console", "interruptible", "progress_bars", "watched_by"]


class _StandardError:
    """The current `sys.stderr`. Work goes on if its reader is gone: a closed pipe or terminal."""

    def write(self, text: str) -> int:
        with self._heard() as stream:
            stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._heard() as stream:
            stream.flush()

    @contextmanager
    def _heard(self) -> Iterator[Any]:
        stream = _stderr()
        try:
            yield stream
        except OSError:  # else Python would try again to write the rest when it ends, and fail
            abandon(stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(_stderr(), name)


def _stderr() -> Any:
    return getattr(sys.stderr, "rich_proxied_file", sys.stderr)  # a progress bar wraps the stream


def abandon(stream: Any) -> None:
    """Redirect a stream without a reader to the null device."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


# Text contains the user's words (paths, names of tasks), so none of it is markup.
PLAIN: dict[str, Any] = {"markup": False, "emoji": False, "highlight": False, "soft_wrap": True}
console = Console(file=cast(IO[str], _StandardError()), **PLAIN)


@contextmanager
def progress_bars(shown: bool = True, counted: bool = True) -> Iterator[Progress]:
    """Show progress on standard error: bars on a terminal, lines elsewhere, nothing unless `shown`.

    `counted`: bars also show how much of how much is done.
    """
    if shown and not console.is_terminal:
        with ProgressLines() as lines:
            yield lines
        return
    columns = (
        TextColumn("{task.description:<12}", markup=False),
        BarColumn(),
        *([MofNCompleteColumn()] if counted else []),
        TextColumn("{task.fields[note]}", markup=False),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not shown) as bars:
        yield bars


FIRST, EVERY = 1.0, 5.0  # seconds until the first line of progress, and between two
PATIENCE = 6  # times as long until a line that says nothing new


class ProgressLines(Progress):
    """Progress as lines, for a file or a pipe: the first after `FIRST`, then one in `EVERY` seconds."""

    def __init__(self) -> None:
        super().__init__(console=console, disable=True, auto_refresh=False)
        self._newest: TaskID | None = None  # the piece of work that moved last
        self._told, self._silent, self._ended = "", 0, threading.Event()
        self._thread = threading.Thread(target=self._tell_on, name="progress", daemon=True)

    def start(self) -> None:
        """Start the thread that prints lines."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread that prints lines."""
        self._ended.set()
        self._thread.join()

    def add_task(self, *arguments: Any, **options: Any) -> TaskID:
        """Add a piece of work."""
        self._newest = super().add_task(*arguments, **options)
        return self._newest

    def remove_task(self, task_id: TaskID) -> None:
        """Remove a piece of work."""
        self._newest = None if self._newest == task_id else self._newest
        super().remove_task(task_id)

    def update(self, task_id: TaskID, **options: Any) -> None:
        """Set the progress of a piece of work."""
        super().update(task_id, **options)
        self._newest = task_id

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Add to the progress of a piece of work."""
        super().advance(task_id, advance)
        self._newest = task_id

    def tell(self) -> None:
        """Print a line about the piece of work that moved last, if the line is new or none was printed for long."""
        task = self._tasks.get(self._newest) if self._newest is not None else None
        if task is None:
            return
        parts = [task.description]
        if task.total:
            parts.append(f"{task.completed:,.0f} of {task.total:,.0f}")
        line = ", ".join([*parts, *([note] if (note := task.fields.get("note")) else [])])
        self._silent = self._silent + 1 if line == self._told else 0
        if self._silent % PATIENCE:
            return
        self._told = line
        left = f", about {task.time_remaining:.0f} s left" if task.time_remaining else ""
        console.print(f"{line}; after {task.elapsed or 0:.0f} s{left}")

    def _tell_on(self) -> None:
        wait = FIRST
        while not self._ended.wait(wait):
            self.tell()
            wait = EVERY


def watched_by(bars: Progress) -> Callable[[str], Callable[[int, int], None]]:
    """Return a function that starts a bar for a piece of work and returns the bar's progress callback."""

    def watch(what: str) -> Callable[[int, int], None]:
        bar = bars.add_task(what, total=None, note="")
        return lambda done, count: bars.update(bar, completed=done, total=count)

    return watch
