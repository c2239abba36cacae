"""Messages and progress of long work, on standard error."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any, cast

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

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
    """Return progress bars on standard error, hidden ones if progress is off; `counted` adds numbers."""
    columns = (
        TextColumn("{task.description:<12}", markup=False),
        BarColumn(),
        *([MofNCompleteColumn()] if counted else []),
        TextColumn("{task.fields[note]}", markup=False),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not shown) as bars:
        yield bars


def watched_by(bars: Progress) -> Callable[[str], Callable[[int, int], None]]:
    """Return a function that starts a bar for a piece of work and returns the bar's progress callback."""

    def watch(what: str) -> Callable[[int, int], None]:
        bar = bars.add_task(what, total=None, note="")
        return lambda done, count: bars.update(bar, completed=done, total=count)

    return watch
