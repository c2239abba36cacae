"""An append-only table on disk: JSONL while it grows, Parquet once it is done; nothing here knows what a row means.

Each line of the JSONL file is an object, of one of three kinds:

    {"about": {...}}         what the table is, once, at its head; in Parquet it is metadata of the schema
    {"constants": {...}}     columns that stay the same: they hold for all lines after it, until the next such line
    {"step": 10, ...}        a row

A line is on the disk when the call that writes it returns. A kill can tear the last line only, which readers leave out
and whoever continues the table drops. Whatever replaces a file does so in one step.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cuelearner_jax.errors import UserError

META = b"cuelearner"  # the key under which Parquet holds what the table is
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
    checksums: bool = False  # does each page of the Parquet file carry one?
    remedy: str = "is corrupt: restore it"  # what a message says of a damaged file, after its path

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
        there, last = _rewrite(self.path, schema, keep=lambda row: True) if self.path.exists() else (None, None)
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
        self._file.write("".join(json.dumps(line, allow_nan=False) + "\n" for line in lines))
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
    found = json.loads(lines[-1]) if lines else {}
    return found if schema.mark in found else None


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
    if about is not None:
        table = _described(table, about)
    with _replacing(path, "wb") as file:
        pq.write_table(table, file, compression="zstd", write_page_checksum=schema.checksums)


def read(path: Path, schema: Schema) -> pa.Table:
    """One file of a table with its types; no rows, no columns where it has just begun.

    Raises:
        UserError: if the file is corrupt or is no table of this schema.
    """
    if path.suffix != ".parquet" and not path.exists():
        path = path.with_name(schema.parquet)  # the table was finished since the file was found
    try:
        table = pq.read_table(path, page_checksum_verification=True) if _is_parquet(path) else _grown(path, schema)
        types = [(name, schema.type(name)) for name in table.column_names]
        table = table.cast(pa.schema(types, metadata=table.schema.metadata))
    except (OSError, TypeError, pa.ArrowException) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise UserError(f"{path} {schema.remedy} ({reason})") from error
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


def _described(table: pa.Table, about: Row) -> pa.Table:
    return table.replace_schema_metadata({META: json.dumps(about).encode()})


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


@contextmanager
def _replacing(path: Path, mode: str) -> Iterator[IO[Any]]:
    """A file that takes the place of `path` once it is whole and on the disk."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open(mode, encoding=None if "b" in mode else "utf-8") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def _lines(path: Path, schema: Schema) -> Iterator[Row]:
    """The lines of a JSONL file, parsed, without a torn last one."""
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from error
    for number, line in enumerate(lines, start=1):
        try:
            parsed = json.loads(line)
        except ValueError as error:  # also what UnicodeDecodeError is
            if number == len(lines):
                return
            raise UserError(f"{path}, line {number}, is not JSON: repair or remove this line") from error
        if not isinstance(parsed, dict) or not parsed.keys() & {"about", "constants", schema.mark}:
            raise UserError(f"{path}, line {number}, is not a row of {schema.stem}: repair or remove this line")
        yield parsed


def _rewrite(path: Path, schema: Schema, keep: Callable[[Row], bool]) -> tuple[Row | None, Row | None]:
    """Rewrites a JSONL file with the rows to keep; returns what it is and the constants that hold at its end."""
    told, constants = None, None
    with _replacing(path, "w") as file:
        for line in _lines(path, schema):
            told, constants = line.get("about", told), line.get("constants", constants)
            if "about" in line or "constants" in line or keep(line):
                file.write(json.dumps(line) + "\n")
    return told, constants


def _reopen(path: Path, schema: Schema) -> None:
    """Turns a finished table back into JSONL, so that it can be continued."""
    whole = path.with_name(schema.parquet)
    if not whole.exists():
        return
    if not path.exists():
        table = read(whole, schema)
        told = about_of(table)
        with _replacing(path, "w") as file:
            if told is not None:
                file.write(json.dumps({"about": told}) + "\n")
            for row in table.to_pylist():
                file.write(json.dumps({name: value for name, value in row.items() if value is not None}) + "\n")
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
    return table if told is None else _described(table, told)
