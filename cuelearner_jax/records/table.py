"""An append-only table on disk: JSONL while it grows, Parquet once it is done; nothing here knows what a row means.

Each line of the JSONL file is an object, of one of three kinds:

    {"about": {...}}         what the table is, once, at its head; in Parquet it is metadata of the schema
    {"constants": {...}}     columns that stay the same: they hold for all lines after it, until the next such line
    {"step": 10, ...}        a row

A line is on the disk when the call that writes it returns. A kill can tear the last line only, which readers leave out
and whoever continues the table drops. Whatever replaces a file does so in one step.

A reader gives what was written or nothing: every line ends in a checksum of itself and of the lines before it, so that
none can be changed or taken out of the middle; Parquet holds a digest of its contents. Files of before had neither.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cuelearner_jax.errors import UserError
from cuelearner_jax.records.whole import replacing, unreadable

META = b"cuelearner"  # the key under which Parquet holds what the table is
DIGEST = b"cuelearner.sha256"  # and the one of the digest of its contents
CHECKSUM = re.compile(rb', "crc": "([0-9a-f]{8})"}$')  # the end of a line
TAIL = 1 << 16  # more than the longest row of most tables [bytes]

PathLike = str | os.PathLike[str]
Row = dict[str, Any]
Writer = TypeVar("Writer", bound="TableWriter")


@dataclass(frozen=True)
class Schema:
    """What the rows of a kind of table are. Columns that are not named here hold floats."""

    stem: str  # of the files' names, and what messages call the rows
    mark: str  # a line of JSON with this key is a row
    required: tuple[str, ...]
    strings: tuple[str, ...] = ()
    integers: tuple[str, ...] = ()
    lists: tuple[str, ...] = ()  # of 32-bit floats
    remedy: str = "is damaged: restore it"  # what a message says of a damaged file, after its path

    @property
    def jsonl(self) -> str:
        """Name of the file while the table grows."""
        return f"{self.stem}.jsonl"

    @property
    def parquet(self) -> str:
        """Name of the file once the table is done."""
        return f"{self.stem}.parquet"

    def growing(self, path: PathLike) -> Path:
        """The JSONL file of a table, given that, its Parquet file or its folder."""
        path = Path(path)
        return path.with_name(self.jsonl) if path.name in (self.jsonl, self.parquet) else path / self.jsonl

    def type(self, name: str) -> pa.DataType:
        """The type of a column."""
        if name in self.strings:
            return pa.string()
        if name in self.integers:
            return pa.int64()
        return pa.list_(pa.float32()) if name in self.lists else pa.float64()


class TableWriter:
    """Appends rows to the JSONL file of one table; every append is on the disk when the call returns.

    Opening an existing table continues it: a torn last line, left by a crash, is dropped first, and a table that was
    already finished (Parquet) becomes JSONL again.
    """

    def __init__(
        self, folder: PathLike, schema: Schema, constants: Row | None = None, about: Row | None = None
    ) -> None:
        """Opens the table in `folder`, creating both where needed.

        Args:
            folder: where the table lies.
            schema: what its rows are.
            constants: columns with one value for all rows to come; None: there are none.
            about: what the table is, written at the head of a new one; that of an existing one stays.
        """
        self.path = Path(folder) / schema.jsonl
        self._schema, self._columns = schema, set(constants or ())
        self.path.parent.mkdir(parents=True, exist_ok=True)
        _reopen(self.path, schema)
        there, last, self._checksum = None, None, 0
        if self.path.exists():
            there, last, self._checksum = _rewrite(self.path, schema, keep=lambda row: True)
        header = None if constants is None else {name: _plain(value) for name, value in constants.items()}
        self._file = self.path.open("a", encoding="utf-8")
        if about is not None and there is None:
            self._write([{"about": about}])
        if header is not None and header != last:
            self._write([{"constants": header}])

    def append(self, **columns: Any) -> None:
        """Appends rows.

        Args:
            columns: what holds for all rows (a scalar; for a column of lists, one list), or arrays with the rows as
                leading axis, all of one length. For instance `append(step=1000, seed=seeds, reward=rewards)`.

        Raises:
            ValueError: if a required column is missing or the lengths differ.
        """
        missing = [name for name in self._schema.required if name not in columns and name not in self._columns]
        if missing:
            raise ValueError(f"a row of {self._schema.stem} needs the columns {', '.join(missing)}")
        arrays = {name: np.asarray(value) for name, value in columns.items()}
        own = {name: array.ndim == (name in self._schema.lists) for name, array in arrays.items()}  # one for all rows
        lengths = {len(array) for name, array in arrays.items() if not own[name]}
        if len(lengths) > 1:
            raise ValueError(f"columns of one append must have one length, got {sorted(lengths)}")
        # tolist() turns NumPy and JAX values into plain Python ones, in one transfer for each column.
        values = {name: array.tolist() for name, array in arrays.items()}
        self._write(
            {name: _plain(value if own[name] else value[row]) for name, value in values.items()}
            for row in range(lengths.pop() if lengths else 1)
        )

    def close(self) -> None:
        """Closes the file; the table stays JSONL until `finish`."""
        self._file.close()

    def __enter__(self: Writer) -> Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, lines: Iterable[Row]) -> None:
        for line in lines:
            text, self._checksum = _sealed(line, self._checksum)
            self._file.write(text)
        self._file.flush()
        os.fsync(self._file.fileno())


def last_row(path: PathLike, schema: Schema) -> Row | None:
    """The newest complete row of a table that is still being written, without looking at the others."""
    try:
        with schema.growing(path).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            lines = file.read().split(b"\n")[:-1]
    except FileNotFoundError:
        return None
    try:
        found = json.loads(lines[-1]) if lines else {}
    except ValueError:  # whoever reads the whole table says so
        return None
    if not isinstance(found, dict) or schema.mark not in found:
        return None
    found.pop("crc", None)
    return found


def truncate(path: PathLike, schema: Schema, keep: Callable[[Row], bool]) -> None:
    """Drops the rows that are not to be kept and a torn last line; without a table nothing happens.

    Args:
        path: folder of the table, or its file.
        schema: what its rows are.
        keep: says of a row whether it stays.
    """
    path = schema.growing(path)
    _reopen(path, schema)
    if path.exists():
        _rewrite(path, schema, keep)


def finish(path: PathLike, schema: Schema) -> Path:
    """Turns the JSONL of a table that is done into Parquet and removes it; returns the Parquet file.

    Args:
        path: folder of the table, or its file. A table that is finished already is left as it is.
        schema: what its rows are.

    Raises:
        UserError: if there is no table, it has no rows or it cannot be read.
    """
    path = schema.growing(path)
    target = path.with_name(schema.parquet)
    if path.exists():
        table = read(path, schema)
        if table.num_rows == 0:
            raise UserError(f"{path} has no rows: a table of {schema.stem} cannot be finished before its first one")
        write(target, table, schema)
        path.unlink()
    elif not target.exists():
        raise UserError(f"no {schema.stem} in {path.parent}: expected {schema.jsonl} or {schema.parquet}")
    return target


def write(path: Path, table: pa.Table, schema: Schema, about: Row | None = None) -> None:
    """Writes a whole table as Parquet, replacing `path` in one step; `about` is what the table is."""
    told = about_of(table) if about is None else about
    table = _typed(table, schema)
    told = {} if told is None else {META: json.dumps(told).encode()}
    table = table.replace_schema_metadata({**told, DIGEST: digest(table, told.get(META, b"")).encode()})
    with replacing(path, "wb") as file:
        pq.write_table(table, file, compression="zstd", write_page_checksum=True)


def digest(table: pa.Table, about: bytes = b"") -> str:
    """SHA-256 of a table's columns: their names, types and values, in order; and of what it says of itself."""
    found = hashlib.sha256(about)
    for name in table.column_names:
        column = table[name].combine_chunks()
        found.update(json.dumps([name, str(column.type), len(column)]).encode())
        if pa.types.is_list(column.type):
            found.update(np.asarray(column.value_lengths().fill_null(-1)).tobytes())
            column = column.flatten()
        if pa.types.is_string(column.type):
            column = column.dictionary_encode()
            found.update(json.dumps(column.dictionary.to_pylist()).encode())
            column = column.indices
        found.update(np.asarray(column.is_null()).tobytes())
        found.update(np.asarray(column.fill_null(0)).tobytes())
    return found.hexdigest()


def read(path: Path, schema: Schema) -> pa.Table:
    """One file of a table with its types; no rows, no columns where it has just begun.

    Raises:
        UserError: if the file is corrupt or is no table of this schema.
    """
    if path.suffix != ".parquet" and not path.exists():
        path = path.with_name(schema.parquet)  # the table was finished since the file was found
    try:
        table = _finished(path, schema) if _is_parquet(path) else _grown(path, schema)
    except OSError as error:
        if error.errno is None:  # Arrow's own
            raise _damaged(path, schema, error) from error
        raise unreadable(path, error) from error
    except (TypeError, ValueError, MemoryError, OverflowError, pa.ArrowException) as error:
        raise _damaged(path, schema, error) from error
    missing = [name for name in schema.required if name not in table.column_names]
    if missing and table.num_rows:
        raise UserError(
            f"{path} lacks the columns {', '.join(missing)}: it is not a table of {schema.stem} of this package"
        )
    return table


def about_of(table: pa.Table) -> Row | None:
    """What a table says of itself. Raises ValueError if that is no JSON object."""
    told = (table.schema.metadata or {}).get(META)
    about = None if told is None else json.loads(told)
    if not isinstance(about, dict | None):
        raise ValueError(f"a table says of itself {about!r}, which is no JSON object")
    return about


def _damaged(path: Path, schema: Schema, reason: object) -> UserError:
    return UserError(f"{path} {schema.remedy} ({(str(reason).splitlines() or [''])[0]})")


def _typed(table: pa.Table, schema: Schema) -> pa.Table:
    """With the columns' types, and what it says of itself."""
    types = [(name, schema.type(name)) for name in table.column_names]
    return table.cast(pa.schema(types, metadata=table.schema.metadata))


def _finished(path: Path, schema: Schema) -> pa.Table:
    """The table of a Parquet file. Raises ValueError if it is not what was written."""
    table = _typed(pq.read_table(path, page_checksum_verification=True), schema)
    metadata = table.schema.metadata or {}
    told = metadata.get(DIGEST)
    if told is not None and told.decode() != digest(table, metadata.get(META, b"")):
        raise ValueError("its contents are not those that were written")
    return table.replace_schema_metadata({META: metadata[META]} if META in metadata else None)


def _is_parquet(path: Path) -> bool:
    if path.suffix in (".parquet", ".jsonl"):
        return path.suffix == ".parquet"
    with path.open("rb") as file:
        return file.read(4) == b"PAR1"


def _plain(value: Any) -> Any:
    """A JSON value: strict JSON has no NaN and no infinity, so they become null; a success is 1.0, not true."""
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    value = value.item() if isinstance(value, np.generic) else value
    value = float(value) if isinstance(value, bool) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _sealed(line: Row, before: int) -> tuple[str, int]:
    """A line as it is written, its checksum at its end, and that checksum; `before`: that of the line before."""
    text = json.dumps(line, allow_nan=False)
    checksum = zlib.crc32(text.encode(), before)
    return f'{text[:-1]}, "crc": "{checksum:08x}"}}\n', checksum


def _lines(path: Path, schema: Schema) -> Iterator[Row]:
    """The lines of a JSONL file, parsed, without a torn last one. Raises UserError for one that is damaged."""
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as error:
        raise unreadable(path, error) from error
    sealed, checksum = any(map(CHECKSUM.search, lines)), 0  # lines of before have no checksums
    for number, line in enumerate(lines, start=1):
        try:
            text, checksum = _opened(line, checksum) if sealed else (line, 0)
            parsed = json.loads(text)
            if not isinstance(parsed, dict) or not parsed.keys() & {"about", "constants", schema.mark}:
                raise ValueError(f"it is not a row of {schema.stem}")
        except (ValueError, RecursionError) as error:
            if number == len(lines):  # what has no end was torn by a crash
                return
            raise _damaged(path, schema, f"line {number}: {error}") from error
        yield parsed


def _opened(line: bytes, before: int) -> tuple[bytes, int]:
    """A line without its checksum, and that; the inverse of `_sealed`. Raises ValueError if it was changed."""
    found = CHECKSUM.search(line)
    text = line[: found.start()] + b"}" if found else b""
    checksum = zlib.crc32(text, before)
    if not found or int(found[1], 16) != checksum:
        raise ValueError("it, or a line before it, is not what was written")
    return text, checksum


def _rewrite(path: Path, schema: Schema, keep: Callable[[Row], bool]) -> tuple[Row | None, Row | None, int]:
    """Rewrites a JSONL file with the rows to keep.

    Returns:
        What it is, the constants that hold at its end, and the checksum of its last line.
    """
    told, constants, checksum = None, None, 0
    with replacing(path) as file:
        for line in _lines(path, schema):
            told, constants = line.get("about", told), line.get("constants", constants)
            if "about" in line or "constants" in line or keep(line):
                text, checksum = _sealed(line, checksum)
                file.write(text)
    return told, constants, checksum


def _reopen(path: Path, schema: Schema) -> None:
    """Turns a finished table back into JSONL, so that it can be continued."""
    whole = path.with_name(schema.parquet)
    if not whole.exists():
        return
    if not path.exists():
        table = read(whole, schema)
        told = about_of(table)
        lines = [] if told is None else [{"about": told}]
        lines += [{name: value for name, value in row.items() if value is not None} for row in table.to_pylist()]
        checksum = 0
        with replacing(path) as file:
            for line in lines:
                text, checksum = _sealed(line, checksum)
                file.write(text)
    whole.unlink()


def _grown(path: Path, schema: Schema) -> pa.Table:
    """The table of a JSONL file, constants included."""
    told: Row | None = None
    constants: Row = {}
    columns: dict[str, list[Any]] = {}
    count = 0
    for line in _lines(path, schema):
        if "about" in line or "constants" in line:
            told, constants = line.get("about", told), line.get("constants", constants)
            continue
        for name, value in (constants | line).items():
            column = columns.setdefault(name, [])
            column.extend([None] * (count - len(column)))  # a column that earlier rows lacked
            column.append(value)
        count += 1
    table = pa.table(
        {name: pa.array(column + [None] * (count - len(column)), schema.type(name)) for name, column in columns.items()}
    )
    table = _typed(table, schema)
    return table if told is None else table.replace_schema_metadata({META: json.dumps(told).encode()})
