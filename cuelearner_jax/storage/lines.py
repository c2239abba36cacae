"""Checksummed lines of JSON in a growing file, so that a reader detects any change, loss or truncation.

Each line is an object that ends in a checksum of itself and of all lines before it. The closing line, `{"end": N}`,
gives the number of lines; an append overwrites it and adds a new one, in one step. So a changed line, a removed line, a
line without its checksum and a cut at any byte are all detected.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from cuelearner_jax.errors import one_line
from cuelearner_jax.storage.room import check_size
from cuelearner_jax.storage.whole import replacing, unreadable
from cuelearner_jax.terminal import console

Row = dict[str, Any]
CHECKSUM = re.compile(rb', "crc": "([0-9a-f]{8})"}$')  # the end of a line
END = "end"  # the key of the closing line


class Damaged(ValueError):
    """Raised for lines that differ from what was written; the message says which line and why."""


class Lines(NamedTuple):
    """A file's rows without checksums, and whether the closing line is present."""

    rows: list[Row]
    is_closed: bool


class Writer:
    """Appends lines; on return they are on disk or, after an error, the file is unchanged."""

    def __init__(self, path: Path, rows: Iterable[Row]) -> None:
        """Replace the file by these lines atomically and open it for appending."""
        text, self._closing, self._count, self._checksum = _sealed(rows, 0, 0)
        with replacing(path, "wb") as file:
            file.write(text + self._closing)
        self._at = len(text)  # where the closing line begins [bytes]
        self._file = path.open("r+b", buffering=0)

    def append(self, rows: Iterable[Row]) -> None:
        """Append lines. Raises OSError if the disk refuses them."""
        text, closing, count, checksum = _sealed(rows, self._count, self._checksum)
        try:
            self._put(text + closing)
        except OSError:
            with contextlib.suppress(OSError):  # rewrite bytes that were on the disk before
                self._file.truncate(self._at)
                self._put(self._closing)
            raise
        self._at, self._count, self._checksum, self._closing = self._at + len(text), count, checksum, closing

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _put(self, content: bytes) -> None:
        number, at = self._file.fileno(), self._at
        while content:
            written = os.pwrite(number, content, at)
            content, at = content[written:], at + written
        os.fsync(number)


def read(path: Path) -> Lines:
    """Read and parse the lines of a file.

    A missing closing line means that the file was cut, or torn by a crash of the machine. Then all whole lines are
    returned, with a warning on standard error.

    Raises:
        UserError: the file cannot be read, or is larger than memory.
        Damaged: a line differs from what was written.
    """
    try:
        check_size(path)
        *lines, rest = path.read_bytes().split(b"\n")
    except OSError as error:
        raise unreadable(path, error) from error
    rows: list[Row] = []
    checksum, closed = 0, False
    for number, line in enumerate(lines, start=1):
        if closed:
            raise Damaged(f"line {number}: it follows the closing line")
        try:
            row, checksum = _opened(line, checksum)
        except (ValueError, RecursionError) as error:
            raise Damaged(f"line {number}: {error}") from error
        closed = row.keys() == {END}
        if closed and row[END] != len(rows):
            raise Damaged(f"line {number}: it closes {row[END]} lines")
        if not closed:
            rows.append(row)
    if not closed:
        with contextlib.suppress(ValueError, RecursionError):
            row, _ = _opened(rest, checksum)
            rows += [row] if row.keys() != {END} else []
    closed = closed and not rest
    if not closed:
        _tell(
            f"{path} lacks its closing line: it was cut, or torn by a crash; only its {len(rows)} whole lines are read"
        )
    return Lines(rows, closed)


@functools.cache  # one warning per message, however often a file is read
def _tell(words: str) -> None:
    console.print(f"warning: {one_line(words)}")


def _sealed(rows: Iterable[Row], count: int, checksum: int) -> tuple[bytes, bytes, int, int]:
    """Seal lines that follow `count` others; return (text, closing line, new count, new checksum)."""
    text = []
    for row in rows:
        line, checksum = _seal(row, checksum)
        text.append(line)
    count += len(text)
    return b"".join(text), _seal({END: count}, checksum)[0], count, checksum


def _seal(row: Row, before: int) -> tuple[bytes, int]:
    """Return a line with its checksum at the end, and that checksum; `before`: the checksum of the line before."""
    text = json.dumps(row, allow_nan=False).encode()
    checksum = zlib.crc32(text, before)
    return text[:-1] + f', "crc": "{checksum:08x}"}}\n'.encode(), checksum


def _opened(line: bytes, before: int) -> tuple[Row, int]:
    """Return a line without its checksum, and the checksum. Raises ValueError if the line was changed."""
    found = CHECKSUM.search(line)
    if not found:
        raise ValueError("it has no checksum, so it, or a line before it, is not what was written")
    text = line[: found.start()] + b"}"
    checksum = zlib.crc32(text, before)
    if int(found[1], 16) != checksum:
        raise ValueError("it, or a line before it, is not what was written")
    row = json.loads(text)
    if not isinstance(row, dict):
        raise ValueError("it is not a JSON object")
    return row, checksum
