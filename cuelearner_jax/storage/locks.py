"""Lock files: one process holds each at a time, and its identity is written into the file."""

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
def hold(lock: Path, what: Path, stays: bool) -> Iterator[None]:
    """Hold a lock file that claims the folder `what`; the lock ends however the process ends.

    A file is locked, not the folder, since NFS passes only file locks on between machines. The file is made if
    missing; with `stays` it remains afterwards.

    Raises UserError if another process holds the lock.
    """
    try:
        descriptor = open_locked(lock, wait=False)
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


def open_locked(file: Path, wait: bool) -> int:
    """Open a file, made if missing, that this process alone has locked; return its descriptor.

    Raises BlockingIOError if another process has the lock and `wait` is false.
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
        os.close(descriptor)  # the process before renamed or removed the file, so the name stands for another file now


def holder(lock: Path) -> str | None:
    """Return who holds a lock, as "process N on MACHINE"; None if nobody does, or the holder is unknown."""
    with contextlib.suppress(OSError), lock.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return file.read().decode(errors="replace") or None
    return None
