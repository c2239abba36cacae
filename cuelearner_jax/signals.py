"""Ctrl-C and schedulers' signals: finish and save work that can be saved, else end at once with one line.

In a command's own process a thread hears signals, also while compiled code keeps Python waiting, and ends the process
without Python's shutdown, in which threads that still compute would crash. Elsewhere (notebooks, tests) Python's own
handlers run, between two calls of compiled code. Files are written whole, so that no moment is a bad one to end.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, a scheduler, a terminal that was closed
SHOW_CURSOR = b"\r\x1b[K\x1b[?25h"  # clears a progress bar's line and shows its cursor


class Interrupted(Exception):
    """The user or a scheduler asked to stop. Everything is saved."""

    status = 130  # exit status of the command: 128 plus the signal's number


class _Work(threading.Event):
    """Work that the first signal asks to stop."""

    number: int = signal.SIGINT  # of that signal
    name: str = ""


_works: list[_Work] = []  # what can be finished and saved, the innermost last
_listening = threading.Event()  # set in a process of the command's own


@contextmanager
def interruptible(what: str = "this stretch of steps") -> Iterator[threading.Event]:
    """Yield an event that the first signal sets. A second Ctrl-C stops at once and loses unsaved work.

    An `Interrupted` that is raised inside ends the command with the status of that signal. `what`: the work that is
    finished first, in words.
    """
    work = _Work()
    work.name = what
    if threading.current_thread() is not threading.main_thread():
        yield work
        return
    before = {} if _listening.is_set() else _install(_hear, ignored=(signal.SIGTERM, signal.SIGHUP))
    _works.append(work)
    try:
        yield work
    except Interrupted as end:
        end.status = 128 + work.number
        raise
    finally:
        _works.remove(work)
        for number, handler in before.items():
            signal.signal(number, handler)


def finish_work() -> None:
    """Ask the innermost work that can be finished and saved to end, as a signal does; without such do nothing."""
    if _works:
        _works[-1].set()


def listen() -> None:
    """Make a signal end this process at once with one line and status 128 plus its number, except in `interruptible`.

    For a process that runs only a command. Signals that the process was started to ignore (nohup) stay ignored.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    handlers = _install(lambda number, frame: None, ignored=NUMBERS)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    _listening.set()

    def hear() -> None:
        while number := os.read(reading, 1)[0]:
            if number in handlers:
                _hear(number)

    threading.Thread(target=hear, name="signals", daemon=True).start()


def _install(handler: Any, ignored: tuple[int, ...]) -> dict[int, Any]:
    """Handle the signals, without those of `ignored` that this process ignores; return the former handlers."""
    spared = [number for number in ignored if signal.getsignal(number) == signal.SIG_IGN]
    return {number: signal.signal(number, handler) or signal.SIG_DFL for number in NUMBERS if number not in spared}


def _hear(number: int, frame: Any = None) -> None:
    work = _works[-1] if _works else None
    if work is not None and not work.is_set():
        work.number = number
        work.set()
        with contextlib.suppress(OSError, ValueError):  # the reader may be gone
            print(f"stopping after {work.name} (Ctrl-C again: at once)", file=sys.stderr, flush=True)
    elif work is None or number == signal.SIGINT:  # schedulers repeat their signal, and kill in the end
        if not _listening.is_set():
            raise KeyboardInterrupt
        with contextlib.suppress(OSError):  # bypasses Python's streams, whose locks another thread may hold
            os.write(2, SHOW_CURSOR * os.isatty(2) + b"stopped at once; what was saved before is safe\n")
        os._exit(128 + number)
