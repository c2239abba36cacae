"""Files that are there as a whole or not at all, and what is said of one that cannot be read."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from cuelearner_jax.errors import UserError

TEMPORARY = ".tmp"  # the end of the name of a file that is not whole yet


@contextmanager
def replacing(path: Path, mode: str = "w") -> Iterator[IO[Any]]:
    """A file that takes the place of `path` in one step, once it is whole and on the disk; text is UTF-8."""
    temporary = path.with_name(path.name + TEMPORARY)
    with temporary.open(mode, encoding=None if "b" in mode else "utf-8") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def unreadable(path: Path, error: OSError) -> UserError:
    """What is raised for a file that the system does not let us read: nothing is known of what is in it."""
    return UserError(f"{path} cannot be read ({error.strerror or error}): check its permissions, nothing was changed")
