"""Files that one process holds at a time, and that say which one."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from cuelearner_jax import signals
from cuelearner_jax.errors import UserError


@contextmanager
def held(lock: Path, what: Path, stays: bool) -> Iterator[None]:
    """Holds a lock file, made if it is not there, that keeps the folder `what`; it is free however the process ends.

    A file, not the folder, is locked: that is what NFS passes on between machines. `stays`: does the file stay behind?

    Raises UserError if another process holds it.
    """
    try:
        descriptor = locked(lock, wait=False)
    except BlockingIOError:
        by = f" ({found})" if (found := holder(lock)) else ""
        raise UserError(f"{what} is being written by another process{by}: wait for it, or give another --out") from None
    try:
        with nullcontext() if stays else signals.removed(lock):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
            yield
    finally:
        os.ftruncate(descriptor, 0)
        os.close(descriptor)


def locked(file: Path, wait: bool) -> int:
    """A file of that name, made if it is not there, that this process alone has locked; as an open descriptor.

    Raises BlockingIOError if another process has it and `wait` is not said.
    """
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), os.stat(file, follow_symlinks=False)):
                    return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # the process before renamed or removed it: this is another file by now


def holder(lock: Path) -> str | None:
    """Who holds a lock, as "process N on MACHINE"; None: nobody, or nobody knows."""
    with contextlib.suppress(OSError), lock.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return file.read().decode(errors="replace") or None
    return None
