"""Locks, and files and folders that appear as a whole or not at all.

While a folder NAME is written these lie beside it: `.NAME.lock`, held by the process that writes; `.NAME.new`, the new
folder until it is complete; `.NAME.old`, the folder to be replaced until the new one is in its place. A killed process
leaves some of them. The next process that writes there removes them, or puts the old folder back if it was moved.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, Any

from filelock import FileLock, Timeout

from cuelearner_jax.errors import UserError


@contextmanager
def hold(lock: Path, what: Path) -> Iterator[None]:
    """Hold a lock file that claims the folder `what`; the lock ends however the process ends."""
    file_lock = FileLock(lock, blocking=False)
    try:
        file_lock.acquire()
    except Timeout:
        raise UserError(f"{what} is being written by another process: wait for it, or give another --out") from None
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        file_lock.release()


@contextmanager
def replacing(path: Path, mode: str = "w", fresh: bool = False) -> Iterator[IO[Any]]:
    """Open a file that replaces `path` atomically once complete and on disk; text is UTF-8.

    `mode`: "w" or "wb". `fresh`: make folders as needed, and raise UserError if the file exists.
    """
    if fresh and os.path.lexists(path):
        raise UserError(f"{path} exists: give another --out")
    if fresh:
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
    try:
        with temporary.open(mode, encoding=None if "b" in mode else "utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def is_occupied(folder: Path) -> bool:
    """Whether a path holds anything but an empty folder."""
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


# () -> a context that makes a new folder to write in, and moves it to its claimed place at the end; a failure leaves
# nothing behind
Place = Callable[[], AbstractContextManager[Path]]


@contextmanager
def place_of(folder: Path, check: Callable[[Path], None], overwrite: bool = False) -> Iterator[Place]:
    """Claim the place of a folder for this process while its new contents are prepared.

    `folder`: links are followed. `check`: raises UserError for an existing folder that may not be replaced; called now,
    and again before the replacement. `overwrite`: whether an existing folder may be replaced at all.
    """
    check(folder)
    target = folder.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    new, old, lock = (target.with_name(f".{target.name}.{name}") for name in ("new", "old", "lock"))

    def tidy() -> None:
        shutil.rmtree(new, ignore_errors=True)
        if old.exists() and is_occupied(target):
            shutil.rmtree(old)
        elif old.exists():
            os.rename(old, target)

    @contextmanager
    def writing() -> Iterator[Path]:
        new.mkdir()
        try:
            yield new
            check(folder)
            if overwrite and is_occupied(target):
                os.rename(target, old)
            os.rename(new, target)
        finally:
            tidy()

    with hold(lock, folder):
        tidy()
        check(folder)  # no other process that claims places can change it any more
        yield writing
