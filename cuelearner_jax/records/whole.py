"""Files that are there as a whole or not at all, and what is said of one that cannot be read."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from cuelearner_jax.errors import UserError

TEMPORARY = ".tmp"  # the end of the name of a file that is not whole yet


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
        with open(_locked(temporary), mode, encoding=None if "b" in mode else "utf-8") as file:
            try:
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


def _locked(temporary: Path) -> int:
    """An open, empty file of that name, which no other process has, as a descriptor."""
    while True:
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), os.stat(temporary, follow_symlinks=False)):
                    os.ftruncate(descriptor, 0)
                    return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # the process before renamed or removed it: this is another file by now


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
