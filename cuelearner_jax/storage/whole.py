"""Files and folders that are there as a whole or not at all, and what is said of a file that cannot be read.

While a folder NAME is written these lie beside it:

    .NAME.lock    held by the process that writes, from before its work until its end
    .NAME.new     what is written, until it is whole
    .NAME.old     what is to be replaced, until the new folder is in its place

A process that is killed leaves some of them; the next one that writes there clears them away, or puts the old folder
back where the new one had not come yet.
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
from cuelearner_jax.storage.locks import held, locked
from cuelearner_jax.terminal import console

TEMPORARY = ".tmp"  # the end of the name of a file that is not whole yet
TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)  # of a folder that cannot be moved: something is there


@contextmanager
def replacing(path: Path, mode: str = "w", fresh: bool = False) -> Iterator[IO[Any]]:
    """A file that takes the place of `path` in one step, once it is whole and on the disk; text is UTF-8.

    Of what fails nothing is left; what a kill left is used by whoever writes the file next. A second process that
    writes the same file waits for the first.

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
        with open(locked(temporary, wait=True), mode, encoding=None if "b" in mode else "utf-8") as file:
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
            with contextlib.suppress(OSError):  # it holds something, or was never made
                folder.rmdir()
        raise
    _sync(path.parent)


def _sync(folder: Path) -> None:
    """Puts a folder's names on the disk, where the file system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def unreadable(path: Path, error: OSError) -> UserError:
    """What is raised for a file that the system does not let us read: nothing is known of what is in it."""
    return UserError(f"{path} cannot be read ({error.strerror or error}): check its permissions, nothing was changed")


class Place:
    """The place of a folder, kept for this process alone; see `place_of`."""

    def __init__(self, folder: Path, check: Callable[[], None], overwrite: bool) -> None:
        self.folder, self._check, self._overwrite = folder, check, overwrite
        self._new, self._old = beside(folder, "new"), beside(folder, "old")

    @contextmanager
    def writing(self) -> Iterator[Path]:
        """A new folder to write in, which is moved to its place at the end; of what fails before nothing is left.

        Raises UserError if something has come to the place that may not be replaced.
        """
        with saving():
            self._new.mkdir()
            try:
                yield self._new
                self._move()
            finally:
                shutil.rmtree(self._new, ignore_errors=True)

    def recover(self) -> None:
        """Clears away what a process left that was killed."""
        if self._new.exists():
            shutil.rmtree(self._new)
        if not self._old.exists():
            return
        if is_used(self.folder):  # by the new one: the last step was missing
            shutil.rmtree(self._old)
            return
        os.rename(self._old, self.folder)
        console.print(f"{self.folder}: replacing it was cut short before, the old folder is back in its place")

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
                    f"{self.folder} was made meanwhile by another program and stays: give another --out"
                ) from None
            raise
        if replaces:
            _sync(self.folder.parent)  # before the old one goes
            shutil.rmtree(self._old)


def beside(folder: Path, what: str) -> Path:
    """What lies beside a folder while it is written: "lock", "new" or "old"."""
    return folder.with_name(f".{folder.name}.{what}")


def is_used(folder: Path) -> bool:
    """Is there anything at a place but an empty folder?"""
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


@contextmanager
def _writable(told: Path) -> Iterator[None]:
    """Raises UserError where the file system cannot have a folder; a full disk is told as everywhere."""
    try:
        yield
    except (OSError, RuntimeError) as error:  # RuntimeError: links in a circle
        if no_space(error):
            raise
        why = getattr(error, "strerror", None) or "links that lead in a circle"
        raise UserError(f"{told} cannot be written ({why}): give another --out") from error


def check_not_aside(folder: Path) -> None:
    """Raises UserError for a folder whose replacement was cut short, so that what was there stands aside."""
    try:
        place = folder.resolve()
        if not place.name or is_used(place) or not (old := beside(place, "old")).exists():
            return
    except (OSError, RuntimeError):  # a name that is too long, or links in a circle: nothing can stand there
        return
    raise UserError(
        f"{folder}: replacing it was cut short, and the folder that was there stands aside as {old}: "
        "rename it back, or give the command that was cut short again"
    )


@contextmanager
def place_of(folder: Path, check: Callable[[Path], None], overwrite: bool = False) -> Iterator[Place]:
    """Keeps the place of a folder for this process while it works on what goes there (`Place.writing`).

    Args:
        folder: where to; a link leads on.
        check: raises UserError for a folder that is there and may not be replaced; asked now, and before it is.
        overwrite: may a folder be replaced at all? Without it a new one is moved to where nothing is.

    Raises:
        UserError: as `check`, or another process has the place.
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
                stack.enter_context(held(beside(folder, "lock"), told, stays=False))
            place = Place(folder, lambda: check(told), overwrite)
            place.recover()
            check(told)  # nobody else who asks can change it any more
            yield place
    finally:
        for parent in missing:  # the innermost first; one in which something was made stays
            with contextlib.suppress(OSError):
                parent.rmdir()
