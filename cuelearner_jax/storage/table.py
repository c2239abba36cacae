"""A table on disk: JSON lines while rows are added, one Parquet file once it is done, whatever the rows mean.

Each JSON line is an object, of one of three kinds:

    {"about": {...}}         a description of the table, once, at its head; in Parquet it is metadata of the schema
    {"constants": {...}}     columns with one value for all later lines, until the next such line
    {"step": 10, ...}        a row

A line is on disk when the call that writes it returns. A last line without its end is what a crash tore, and counts
as not written. A Parquet file holds a SHA-256 of its contents, and is refused if they have another.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cuelearner_jax.errors import UserError, first_line
from cuelearner_jax.storage.whole import replacing

META = b"cuelearner"  # Parquet metadata key of the table's description
DIGEST = b"cuelearner.sha256"  # Parquet metadata key of the digest of the contents
HEADS = {"about", "constants"}  # keys of lines that are no rows

PathLike = str | os.PathLike[str]
Row = dict[str, Any]


@dataclass(frozen=True)
class Schema:
    """Column types of a kind of table. Columns that are not named here hold floats."""

    stem: str  # of the file names; messages call the rows so
    required: tuple[str, ...]
    strings: tuple[str, ...] = ()
    integers: tuple[str, ...] = ()
    lists: tuple[str, ...] = ()  # of 32-bit floats: names, or endings of names
    meanings: Mapping[str, str] = field(default_factory=dict)  # of columns, by name or pattern: the first that fits
    remedy: str = "is damaged: restore it"  # the remedy in the message about a damaged file, after its path

    @property
    def jsonl(self) -> str:
        """Name of the file while the table grows."""
        return f"{self.stem}.jsonl"

    @property
    def parquet(self) -> str:
        """Name of the file once the table is done."""
        return f"{self.stem}.parquet"

    def found_in(self, folder: Path) -> Path | None:
        """Return the table's file in a folder, a finished one first; None if there is none."""
        return next((folder / name for name in (self.parquet, self.jsonl) if (folder / name).exists()), None)

    def type(self, name: str) -> pa.DataType:
        """Return the Arrow type of a column."""
        if name in self.strings:
            return pa.string()
        if name in self.integers:
            return pa.int64()
        return pa.list_(pa.float32()) if self.is_list(name) else pa.float64()

    def is_list(self, name: str) -> bool:
        """Whether a column holds lists."""
        return name.endswith(self.lists)

    def arrow_field(self, name: str) -> pa.Field:
        """Return the Arrow field of a column; its metadata has the column's meaning as `description`."""
        meaning = next((text for key, text in self.meanings.items() if fnmatchcase(name, key)), None)
        return pa.field(name, self.type(name), metadata=meaning and {"description": meaning})

    def cast(self, table: pa.Table) -> pa.Table:
        """Return a table with the columns' types."""
        return table.cast(pa.schema([self.arrow_field(name) for name in table.column_names], table.schema.metadata))

    def table(self, columns: Mapping[str, Any], about: Row | None = None) -> pa.Table:
        """Return columns as a table of this kind, with its description."""
        # Integers are cast last, since Arrow would truncate a fractional value.
        types = {name: None if name in self.integers else self.type(name) for name in columns}
        table = pa.table({name: pa.array(column, types[name]) for name, column in columns.items()})
        return self.cast(table.replace_schema_metadata(None if about is None else {META: json.dumps(about)}))


class TableWriter(contextlib.AbstractContextManager):
    """Appends rows to the JSONL file of one table; each append is on disk when the call returns.

    Opening an existing table continues it: a torn last line is dropped first, and a finished table (Parquet) becomes
    JSONL again.
    """

    def __init__(
        self, folder: PathLike, schema: Schema, constants: Row | None = None, about: Row | None = None
    ) -> None:
        """Open the table in `folder`, creating both where needed.

        `constants`: columns with one value for all rows to come. `about`: the description written at the head of a new
        table; an existing table keeps its own.
        """
        self.path, self._schema = Path(folder) / schema.jsonl, schema
        self.path.parent.mkdir(parents=True, exist_ok=True)
        lines = _reopen(self.path, schema)
        self._file = self.path.open("ab", buffering=0)
        if about is not None and not any("about" in line for line in lines):
            self._put([{"about": about}])
        if constants is not None:
            self._put([{"constants": constants}])

    def append(self, **columns: Any) -> None:
        """Append rows.

        `columns`: values for all rows (a scalar; for a column of lists, one list), or arrays with the rows as leading
        axis. If the disk refuses the rows (OSError), none is in the table, and the call may be repeated.
        """
        arrays = {name: np.asarray(value) for name, value in columns.items()}
        many = {name for name, array in arrays.items() if array.ndim > self._schema.is_list(name)}
        (count,) = {len(arrays[name]) for name in many} or {1}
        # tolist() turns NumPy and JAX values into plain Python values, with one transfer per column.
        values = {name: plain(array.tolist()) for name, array in arrays.items()}
        value_in = lambda name, row: values[name][row] if name in many else values[name]  # noqa: E731
        self._put({name: value_in(name, row) for name in values} for row in range(count))

    def _put(self, rows: Iterable[Row]) -> None:
        """Append lines, on disk when this returns; after an error the file is as before."""
        size, text = os.fstat(self._file.fileno()).st_size, _text(rows)
        try:
            while text:
                text = text[self._file.write(text) :]
            os.fsync(self._file.fileno())
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(size)
            raise

    def close(self) -> None:
        """Close the file; the table stays JSONL until `finish`."""
        self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def truncate(folder: PathLike, schema: Schema, keep: Callable[[Row], bool]) -> None:
    """Drop a folder's rows for which `keep` is false, and a torn last line; do nothing without a table."""
    path = Path(folder) / schema.jsonl
    if lines := _reopen(path, schema):
        _rewrite(path, [line for line in lines if line.keys() & HEADS or keep(line)])


def finish(folder: PathLike, schema: Schema) -> Path:
    """Convert a folder's JSONL table to Parquet, unless it is finished already; return the Parquet file."""
    path, target = (Path(folder) / name for name in (schema.jsonl, schema.parquet))
    if path.exists():
        write(target, read(path, schema))
        path.unlink()
    return target


def write(path: Path, table: pa.Table, fresh: bool = False) -> None:
    """Write a table of some schema as Parquet, atomically. `fresh`: see `whole.replacing`."""
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), DIGEST: digest(table)})
    with replacing(path, "wb", fresh) as file:
        pq.write_table(table, file, compression="zstd", write_page_checksum=True)


def digest(table: pa.Table) -> str:
    """Return the SHA-256 of a table's column names, types and values, in order, and of its description."""
    hasher = hashlib.sha256((table.schema.metadata or {}).get(META, b""))
    for name in table.column_names:
        column = table[name].combine_chunks()
        hasher.update(json.dumps([name, str(column.type), len(column)]).encode())
        if pa.types.is_list(column.type):
            hasher.update(np.asarray(column.value_lengths().fill_null(-1)).tobytes())
            column = column.flatten()
        if pa.types.is_string(column.type):
            column = column.dictionary_encode()
            hasher.update(json.dumps(column.dictionary.to_pylist()).encode())
            column = column.indices
        hasher.update(np.asarray(column.is_null()).tobytes())
        hasher.update(np.asarray(column.fill_null(0)).tobytes())
    return hasher.hexdigest()


def read(path: Path, schema: Schema) -> pa.Table:
    """Read one file of a table with its column types; a table that has just begun has no rows and no columns."""
    try:
        if path.suffix == ".jsonl":
            table = _growing(path, schema)
        else:
            with path.open("rb") as file:
                raw = pq.ParquetFile(file).read()
            table = schema.cast(raw)
            if (table.schema.metadata or {}).get(DIGEST, b"").decode() != digest(table):
                raise ValueError("its contents are not those that were written")
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError, pa.ArrowException, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # not one of Arrow's own
            raise
        raise UserError(f"{path} {schema.remedy} ({first_line(error)})") from error
    absent = [name for name in schema.required if name not in table.column_names]
    if absent and table.num_rows:
        why = f"it is not a table of {schema.stem} of this package"
        raise UserError(f"{path} lacks the columns {', '.join(absent)}: {why}")
    return table


def about_of(table: pa.Table) -> Row | None:
    """Return a table's description."""
    text = (table.schema.metadata or {}).get(META)
    return None if text is None else json.loads(text)


def plain(value: Any) -> Any:
    """Convert a value for strict JSON: NaN and infinity become null, a boolean becomes 1.0 or 0.0."""
    if isinstance(value, list):
        return [plain(entry) for entry in value]
    if isinstance(value, dict):
        return {name: plain(entry) for name, entry in value.items()}
    value = float(value) if isinstance(value, bool) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _text(rows: Iterable[Row]) -> bytes:
    return "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows).encode()


def _lines(path: Path) -> list[Row]:
    """Return the whole lines of a JSONL file; without the last if a crash tore it."""
    return [json.loads(line) for line in path.read_bytes().split(b"\n")[:-1]]


def _reopen(path: Path, schema: Schema) -> list[Row]:
    """Return a table's lines, to be continued: a finished table becomes JSONL again, a torn last line is cut off."""
    whole = path.with_name(schema.parquet)
    if whole.exists() and not path.exists():
        table = read(whole, schema)
        head = [] if (about := about_of(table)) is None else [{"about": about}]
        _rewrite(path, [*head, *({k: v for k, v in row.items() if v is not None} for row in table.to_pylist())])
    whole.unlink(missing_ok=True)
    if not path.exists():
        return []
    os.truncate(path, path.read_bytes().rfind(b"\n") + 1)
    return _lines(path)


def _rewrite(path: Path, rows: Iterable[Row]) -> None:
    with replacing(path, "wb") as file:
        file.write(_text(rows))


def _growing(path: Path, schema: Schema) -> pa.Table:
    """Return the table of a JSONL file, constants included."""
    about, constants, rows = None, {}, []
    for line in _lines(path):
        about, constants = line.get("about", about), line.get("constants", constants)
        if not line.keys() & HEADS:
            rows.append(constants | line)
    names = dict.fromkeys(name for row in rows for name in row)
    return schema.table({name: [row.get(name) for row in rows] for name in names}, about)
