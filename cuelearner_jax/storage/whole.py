"""Locks, and files and folders that appear as a whole or not at all.

While a folder NAME is written these lie beside it:

    .NAME.lock    held by the process that writes, from before its work until its end
    .NAME.new     the new folder, until it is complete
    .NAME.old     the folder to be replaced, until the new folder is in its place

A killed process leaves some of them. The next process that writes there removes them, or puts the old folder back if
the new one had not yet taken its place.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from filelock import FileLock, Timeout

from cuelearner_jax.errors import UserError
from cuelearner_jax.signals import saving
from cuelearner_jax.terminal import console


@contextmanager
def hold(lock: Path, what: Path) -> Iterator[None]:
    """Hold a lock file that claims the folder `what`; the lock ends however the process ends.

    Raises UserError if another process holds the lock.
    """
    held = FileLock(lock, blocking=False)
    try:
        held.acquire()
    except Timeout:
        raise UserError(f"{what} is being written by another process: wait for it, or give another --out") from None
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        held.release()


@contextmanager
def replacing(path: Path, mode: str = "w", fresh: bool = False) -> Iterator[IO[Any]]:
    """Open a file that replaces `path` atomically once complete and on disk; text is UTF-8.

    Args:
        path: the file.
        mode: "w" or "wb".
        fresh: make folders as needed, and refuse to replace a file.

    Raises:
        UserError: `fresh`, and the file exists.
    """

    def check() -> None:
        if fresh and os.path.lexists(path):
            raise UserError(f"{path} exists: give another --out")

    check()
    if fresh:
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
    try:
        with temporary.open(mode, encoding=None if "b" in mode else "utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        check()
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def _sync(folder: Path) -> None:
    """Flush a folder's directory entries to disk, where the file system supports that."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def unreadable(path: Path, error: OSError) -> UserError:
    """Return the error for a file that the system does not let this process read."""
    return UserError(f"{path} cannot be read ({error.strerror or error}): check its permissions, nothing was changed")


class Place:
    """A folder's path, claimed for this process alone; see `place_of`."""

    def __init__(self, folder: Path, check: Callable[[], None], overwrite: bool) -> None:
        self.folder, self._check, self._overwrite = folder, check, overwrite
        self._new, self._old = beside(folder, "new"), beside(folder, "old")

    @contextmanager
    def writing(self) -> Iterator[Path]:
        """Make a new folder to write in and move it to the place at the end; a failure leaves nothing behind.

        Raises UserError if something that may not be replaced appeared at the place meanwhile.
        """
        with saving():
            self._new.mkdir()
            try:
                yield self._new
                self._move()
            finally:
                shutil.rmtree(self._new, ignore_errors=True)

    def recover(self) -> None:
        """Remove or restore what a killed process left."""
        if self._new.exists():
            shutil.rmtree(self._new)
        if self._old.exists() and is_used(self.folder):  # the new folder is in place: only the last step was missing
            shutil.rmtree(self._old)
        elif self._old.exists():
            os.rename(self._old, self.folder)
            console.print(f"{self.folder}: its replacement was interrupted, so the old folder was put back")

    def _move(self) -> None:
        self._check()
        replaces = self._overwrite and is_used(self.folder)
        if replaces:
            os.rename(self.folder, self._old)
        try:
            os.rename(self._new, self.folder)
        except OSError as error:
            if replaces:
                os.rename(self._old, self.folder)
            raise UserError(
                f"{self.folder} cannot be put in place ({error.strerror}), nothing was changed: give another --out"
            ) from error
        if replaces:
            _sync(self.folder.parent)  # before the old folder is removed
            shutil.rmtree(self._old)


def beside(folder: Path, what: str) -> Path:
    """Return the path beside a folder that is used while it is written: "lock", "new" or "old"."""
    return folder.with_name(f".{folder.name}.{what}")


def is_used(folder: Path) -> bool:
    """Whether a path holds anything but an empty folder."""
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


@contextmanager
def place_of(folder: Path, check: Callable[[Path], None], overwrite: bool = False) -> Iterator[Place]:
    """Claim the place of a folder for this process while its new contents are prepared (`Place.writing`).

    Args:
        folder: the target; links are followed.
        check: raises UserError for an existing folder that may not be replaced; called now, and again before the
            replacement.
        overwrite: whether an existing folder may be replaced at all.

    Raises:
        UserError: as `check`, or another process has claimed the place.
    """
    check(folder)
    target = folder.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    with hold(beside(target, "lock"), folder):
        place = Place(target, lambda: check(folder), overwrite)
        place.recover()
        check(folder)  # no other process that claims places can change it any more
        yield place
