"""Messages and progress of long work, on standard error."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any, cast

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TaskID, TextColumn
from rich.text import Text

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


@contextmanager
def progress_bars(visible: bool = True) -> Iterator[Progress]:
    """Show progress on standard error: bars on a terminal, lines elsewhere, nothing unless `visible`."""
    if visible and not console.is_terminal:
        yield ProgressLines()
        return
    name, note = (TextColumn(text, markup=False) for text in ("{task.description:<12}", "{task.fields[note]}"))
    columns = name, BarColumn(), MofNCompleteColumn(), note, _TimeLeft()
    with TimedProgress(*columns, console=console, disable=not visible) as bars:
        yield bars


class TimedProgress(Progress):
    """Progress with the time left of each piece of work, from its second stretch on.

    Fields of a piece: `begun`, where it went on, and `ahead`, how many times as much work comes after it.
    """

    def update(self, task_id: TaskID, **options: Any) -> None:
        """Set the progress of a piece of work, and estimate the time left (the field `left`)."""
        super().update(task_id, **options)
        task = self._tasks.get(task_id)
        if task is None or not task.total or task.completed <= task.fields.get("begun", 0):
            return
        now = (task.elapsed or 0.0, task.completed)
        first = task.fields.setdefault("first", now)  # stretch, which compiles and so tells nothing of the rest
        if now[1] == first[1]:
            return
        pace, ahead = (now[0] - first[0]) / (now[1] - first[1]), task.fields.get("ahead", 0) * task.total
        left = [duration(pace * steps) for steps in (task.total - task.completed, task.total - task.completed + ahead)]
        more = f", {left[1]} with the kinds to come" if ahead else ""
        task.fields["left"] = f"about {left[0]} left{more}" if more or not task.finished else ""


class _TimeLeft(ProgressColumn):
    def render(self, task: Any) -> Text:
        """Return the estimate of `TimedProgress`."""
        return Text(task.fields.get("left", ""))


def duration(seconds: float) -> str:
    """Return a duration in its largest unit of which it has two."""
    unit, size = next(((unit, size) for unit, size in (("h", 3600), ("min", 60)) if seconds >= 2 * size), ("s", 1))
    return f"{seconds / size:.0f} {unit}"


FIRST, EVERY = 1.0, 5.0  # seconds until the first line of progress, and between two


class ProgressLines(TimedProgress):
    """Progress as lines, for a file or a pipe: none before `FIRST`, then at most one in `EVERY` seconds."""

    def __init__(self) -> None:
        super().__init__(console=console, disable=True)
        self._next = time.monotonic() + FIRST

    def update(self, task_id: TaskID, **options: Any) -> None:
        """Set the progress of a piece of work, and print a line about it if one is due."""
        super().update(task_id, **options)
        if time.monotonic() < self._next or task_id not in self._tasks:
            return
        self._next = time.monotonic() + EVERY
        task = self._tasks[task_id]
        amount = f"{task.completed:,.0f} of {task.total:,.0f}" if task.total else ""
        parts = ", ".join(filter(None, [task.description, amount, task.fields.get("note")]))
        times = filter(None, [f"after {duration(task.elapsed or 0)}", task.fields.get("left")])
        console.print(f"{parts}; {', '.join(times)}")


def watched_by(bars: Progress) -> Callable[[str], Callable[[int, int], None]]:
    """Return a function that starts a bar for a piece of work and returns the bar's progress callback."""

    def watch(what: str) -> Callable[[int, int], None]:
        bar = bars.add_task(what, total=None, note="")
        return lambda count_so_far, count: bars.update(bar, completed=count_so_far, total=count)

    return watch
