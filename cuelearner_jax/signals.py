"""Handle Ctrl-C and schedulers' signals: finish and save work that can be saved, else end at once with one line.

In a command's own process a thread listens for signals, also while compiled code keeps Python waiting, and ends the
process without Python's shutdown, in which threads that still compute would crash. Elsewhere (notebooks, tests)
Python's own handlers run, between two calls of compiled code.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, a scheduler, a terminal that was closed
SHOW_CURSOR = b"\r\x1b[K\x1b[?25h"  # clears a progress bar's line and shows its cursor

_listening = threading.Event()  # set in a process of the command's own
_leaving = threading.Lock()
_saves = threading.RLock()


class Interrupted(Exception):
    """The user or a scheduler asked to stop. Everything is saved."""

    status = 130  # exit status of the command: 128 plus the signal's number


class Stopping(threading.Event):
    """An event that the first signal sets. It keeps the signal's number."""

    number: int = signal.SIGINT


class _LateSignal:
    """A second Ctrl-C in a process without a listening thread, while a result is being saved."""

    saving = 0
    pressed = False


class _Heard:
    """A handler of signals, called by the listening thread or by Python."""

    def __init__(self, act: Callable[[int], None]) -> None:
        self.act = act

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if not _listening.is_set():
            self.act(number)


@contextmanager
def interruptible(what: str = "this stretch of steps") -> Iterator[threading.Event]:
    """Yield an event that the first signal sets. A second Ctrl-C stops at once and loses unsaved work.

    An `Interrupted` that is raised inside ends the command with the status of that signal.

    Args:
        what: the work that is finished first, in words.
    """
    stopping = Stopping()

    def act(number: int) -> None:
        if not stopping.is_set():
            stopping.number = number
            stopping.set()
            _say(f"stopping after {what} (Ctrl-C again: at once)")
        elif number == signal.SIGINT:  # schedulers repeat their signal, and kill in the end
            _stop_at_once(number)

    if threading.current_thread() is not threading.main_thread():
        yield stopping
        return
    before = _installed(_Heard(act), also=signal.SIGINT)
    try:
        yield stopping
    except Interrupted as end:
        end.status = 128 + stopping.number
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def saving() -> Iterator[None]:
    """Run the body to its end, however often Ctrl-C is pressed."""
    with _saves:
        _LateSignal.saving += 1
        try:
            yield
        finally:
            _LateSignal.saving -= 1
    if _LateSignal.pressed and not _LateSignal.saving:
        _LateSignal.pressed = False
        raise KeyboardInterrupt


def listen() -> None:
    """Make a signal end this process at once with one line and status 128 plus its number, except in `interruptible`.

    For a process that runs only a command. Signals that the process was started to ignore (nohup) stay ignored.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    _installed(_Heard(_stop_at_once))
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    _listening.set()
    threading.Thread(target=_listen, args=(reading,), name="signals", daemon=True).start()


def _listen(reading: int) -> None:
    while heard := os.read(reading, 1):
        handler = signal.getsignal(heard[0])
        if isinstance(handler, _Heard):
            handler.act(heard[0])


def _installed(handler: _Heard, also: int | None = None) -> dict[int, Callable | int]:
    """Handle `also` and the signals that this process was not started to ignore. Return the former handlers."""
    before: dict[int, Callable | int] = {}
    for number in NUMBERS:
        was = signal.getsignal(number)
        if was != signal.SIG_IGN or number == also:
            before[number] = signal.SIG_DFL if was is None else was
            signal.signal(number, handler)
    return before


def _stop_at_once(number: int) -> None:
    if _listening.is_set():
        if not _saves.acquire(blocking=False):
            _say("saving first")
            _saves.acquire()
        _leave(number)
    elif _LateSignal.saving:
        _LateSignal.pressed = True
        _say("saving first")
    else:
        raise KeyboardInterrupt


def _leave(number: int) -> None:
    if not _leaving.acquire(blocking=False):
        return
    with contextlib.suppress(OSError):  # bypasses Python's streams, whose locks another thread may hold
        shown = SHOW_CURSOR if os.isatty(2) else b""
        os.write(2, shown + b"stopped at once; what was saved before is safe\n")
    os._exit(128 + number)


def _say(text: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # the reader may be gone
        print(text, file=sys.stderr, flush=True)
