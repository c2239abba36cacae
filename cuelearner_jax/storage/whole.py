"""Atomic replacement of files and folders, and errors for files that cannot be read.

While a folder NAME is written these lie beside it:

    .NAME.lock    held by the process that writes, from before its work until its end
    .NAME.new     the new folder, until it is complete
    .NAME.old     the folder to be replaced, until the new folder is in its place

A killed process leaves some of them. The next process that writes there removes them, or puts the old folder back if
the new one had not yet taken its place.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from cuelearner_jax.errors import UserError, no_space
from cuelearner_jax.signals import saving
from cuelearner_jax.storage.locks import hold, open_locked
from cuelearner_jax.terminal import console

TEMPORARY = ".tmp"  # suffix of an incomplete file
TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)  # errors of a rename onto something that exists


@contextmanager
def replacing(path: Path, mode: str = "w", fresh: bool = False) -> Iterator[IO[Any]]:
    """Open a file that replaces `path` atomically once complete and on disk; text is UTF-8.

    A failure leaves nothing behind; what a kill left is reused by the next writer. A second process that writes the
    same file waits for the first.

    Args:
        path: the file.
        mode: "w" or "wb".
        fresh: make folders as needed, and refuse to replace a file.

    Raises:
        UserError: `fresh`, and the file exists.
    """
    folders = [folder for folder in path.parents if not folder.exists()] if fresh else []
    temporary = path.with_name(path.name + TEMPORARY)
    try:
        if fresh:
            path.parent.mkdir(parents=True, exist_ok=True)
        with open(open_locked(temporary, wait=True), mode, encoding=None if "b" in mode else "utf-8") as file:
            try:
                file.truncate(0)
                if fresh and os.path.lexists(path):
                    raise UserError(f"{path} exists: give another --out")
                yield file
                file.flush()
                os.fsync(file.fileno())
                os.replace(temporary, path)
            except BaseException:
                temporary.unlink()
                raise
    except BaseException:
        for folder in folders:
            with contextlib.suppress(OSError):  # the folder is not empty, or was never made
                folder.rmdir()
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
        if not self._old.exists():
            return
        if is_used(self.folder):  # the new folder is in place: only the last step was missing
            shutil.rmtree(self._old)
            return
        os.rename(self._old, self.folder)
        console.print(
            f"{self.folder}: an earlier replacement of this folder was interrupted, so the old folder was put back"
        )

    def _move(self) -> None:
        self._check()
        replaces = self._overwrite and is_used(self.folder)
        if replaces:
            os.rename(self.folder, self._old)
        try:
            os.rename(self._new, self.folder)
        except BaseException as error:
            if replaces:
                os.rename(self._old, self.folder)
            if isinstance(error, OSError) and error.errno in TAKEN:
                raise UserError(
                    f"{self.folder} was created meanwhile by another program and is left as it is: give another --out"
                ) from None
            raise
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
def _writable(told: Path) -> Iterator[None]:
    """Raise UserError where the file system cannot have a folder; a full disk keeps its own error."""
    try:
        yield
    except (OSError, RuntimeError) as error:  # RuntimeError: a circle of links
        if no_space(error):
            raise
        why = getattr(error, "strerror", None) or "a circle of links"
        raise UserError(f"{told} cannot be written ({why}): give another --out") from error


def check_not_aside(folder: Path) -> None:
    """Raise UserError for a folder whose replacement was interrupted, with the old folder still set aside."""
    try:
        place = folder.resolve()
        if not place.name or is_used(place) or not (old := beside(place, "old")).exists():
            return
    except (OSError, RuntimeError):  # the name is too long, or a circle of links: nothing can be there
        return
    raise UserError(
        f"{folder}: its replacement was interrupted, and the old folder was set aside as {old}: "
        "rename that folder back, or run the interrupted command again"
    )


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
    told = folder
    with _writable(told):
        folder = folder.resolve()
    check(told)
    missing = [parent for parent in folder.parents if not parent.exists()]
    try:
        with contextlib.ExitStack() as stack:
            with _writable(told):
                folder.parent.mkdir(parents=True, exist_ok=True)
                stack.enter_context(hold(beside(folder, "lock"), told, stays=False))
            place = Place(folder, lambda: check(told), overwrite)
            place.recover()
            check(told)  # no other process that claims places can change it any more
            yield place
    finally:
        for parent in missing:  # the innermost first; a folder with contents stays
            with contextlib.suppress(OSError):
                parent.rmdir()
