"""Recorded situations: observations, the proposed actions, and optionally a picture of each.

A folder holds `situations.parquet`, `.csv` or `.npz`, with pictures beside the table. A LeRobot dataset folder is read
too, see `storage.lerobot`. Columns of the table:

| column      | type                        | meaning                                                             |
|-------------|-----------------------------|---------------------------------------------------------------------|
| observation | list of floats (obs,)       | the policy's input; in CSV numbers separated by spaces             |
| action      | list of floats (action,)    | the proposed or executed action                                     |
| picture     | string                      | optional: a file in the folder, PNG or JPEG, or a clip, GIF or MP4  |

In place of a list there may be one column per entry, `observation.NAME` or `action.NAME`, which names the entries.
Nothing in such a folder is executed: no pickles, and no path that leads out of the folder.
"""

from __future__ import annotations

import hashlib
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float
from pyarrow import csv

from cuelearner_jax.environment import Quantity
from cuelearner_jax.errors import UserError, format_numbers, format_value
from cuelearner_jax.storage import lerobot
from cuelearner_jax.storage.picture_files import Picture, PictureFiles

STEM = "situations"
OBSERVATION, ACTION, PICTURE = "observation", "action", "picture"
MOST_NAMED = 64  # largest number of observation entries that each get a slice of their own


class Situations(NamedTuple):
    """Recorded situations, one per row."""

    observations: Float[np.ndarray, "n obs"]
    actions: Float[np.ndarray, "n action"]
    slices: tuple[Quantity, ...]  # of an observation
    entries: tuple[str, ...]  # names of an action's entries; empty: the recording names none
    digest: str  # of these situations
    has_pictures: bool
    # row -> its picture; None: that row has none. Raises UserError for a picture that cannot be read.
    picture: Callable[[int], Picture | None]


def read(path: Path) -> Situations:
    """Read a folder of situations, its table alone, or a LeRobot dataset folder.

    Raises:
        UserError: nothing to read, missing columns, sizes that do not fit, or a number that is not finite.
    """
    if lerobot.is_dataset(path):
        found = lerobot.read(path)
        slices = named_slices(found.observation_entries, found.observations.shape[1])
        return _whole(path, found.observations, found.actions, slices, found.action_entries, found.frames)
    table = _table_in(path)
    columns = _READERS[table.suffix](table)
    known = (OBSERVATION, ACTION, PICTURE)
    if strange := [name for name in columns if name not in known and name.partition(".")[0] not in known[:2]]:
        raise UserError(
            f"{table} has an unknown column {format_value(strange[0])}: name it {OBSERVATION}.NAME or {ACTION}.NAME, "
            "or leave it out"
        )
    observations, seen = _matrix(table, columns, OBSERVATION)
    actions, entries = _matrix(table, columns, ACTION)
    files = columns.get(PICTURE)
    if len({len(observations), len(actions), len(observations if files is None else files)}) > 1:
        raise UserError(f"{table} has columns of several lengths: give an observation and an action for each situation")
    return _whole(
        table,
        observations,
        actions,
        named_slices(seen, observations.shape[1]),
        entries,
        None if files is None else PictureFiles(table, files),
    )


def _whole(
    path: Path,
    observations: np.ndarray,
    actions: np.ndarray,
    slices: tuple[Quantity, ...],
    entries: tuple[str, ...],
    pictures: Any,
) -> Situations:
    """Check and build `Situations`. Raises UserError if there are none or a number is not finite."""
    for name, rows in ((OBSERVATION, observations), (ACTION, actions)):
        if not rows.size:
            raise UserError(f"{path} holds no {name}s: record some situations first")
        if len(wrong := np.flatnonzero(~np.isfinite(rows).all(-1))):
            raise UserError(
                f"{path}: {name}s of the rows {format_numbers(wrong.tolist())} are not finite: leave these rows out"
            )
    told = hashlib.sha256()
    for rows in (observations, actions):
        told.update(str(rows.shape).encode() + np.ascontiguousarray(rows).tobytes())
    told.update("\n".join([quantity.name for quantity in slices] + ["", *entries]).encode())
    there = (lambda row: None) if pictures is None else pictures
    return Situations(observations, actions, slices, entries, told.hexdigest()[:12], pictures is not None, there)


def named_slices(entries: tuple[str, ...], size: int) -> tuple[Quantity, ...]:
    """Return an observation's slices: one per entry where entries are named and few, else a single one."""
    if len(entries) == size and size <= MOST_NAMED:
        return tuple(Quantity(name, 1, "1", "as recorded") for name in entries)
    return (Quantity(OBSERVATION, size, "1", "as recorded"),)


def _table_in(path: Path) -> Path:
    """Return the table in a folder, or the given table. Raises UserError if there is none."""
    if path.is_file():
        if path.suffix not in _READERS:
            raise UserError(f"{path} is not a table of situations: give a folder, or a file {', '.join(_READERS)}")
        return path
    if not path.is_dir():
        raise UserError(f"there is no folder of situations at {path}: give one that holds {STEM}.parquet")
    found = [path / f"{STEM}{suffix}" for suffix in _READERS if (path / f"{STEM}{suffix}").is_file()]
    if not found:
        empty = "is empty" if not any(path.iterdir()) else f"holds no {STEM}.parquet, .csv or .npz"
        raise UserError(
            f"{path} {empty}, and is not a LeRobot dataset either: give a folder with such a table, with the columns "
            f"{OBSERVATION} and {ACTION}"
        )
    if len(found) > 1:
        raise UserError(f"{path} holds {' and '.join(table.name for table in found)}: give the path of one of them")
    return found[0]


def _of_parquet(table: Path) -> dict[str, Any]:
    try:
        return _columns(table, pq.ParquetFile(table).read())
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _damaged(table, error) from error


def _of_csv(table: Path) -> dict[str, Any]:
    try:
        columns = _columns(table, csv.read_csv(table))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _damaged(table, error) from error
    for name in columns.keys() & {OBSERVATION, ACTION}:
        columns[name] = [re.split(r"[\s;,]+", str(text).strip("[] ")) for text in columns[name]]
    return columns


def _columns(table: Path, rows: pa.Table) -> dict[str, Any]:
    """Return the columns of a table by name. Raises UserError for two columns with one name."""
    names = [name.strip() for name in rows.column_names]
    if doubled := [name for name in names if names.count(name) > 1]:
        raise UserError(f"{table} has two columns {format_value(doubled[0])}: give each column a name of its own")
    return {name: column.to_pylist() for name, column in zip(names, rows.columns, strict=True)}


def _of_npz(table: Path) -> dict[str, Any]:
    try:
        with np.load(table, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise _damaged(table, error) from error


_READERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    ".parquet": _of_parquet,
    ".csv": _of_csv,
    ".npz": _of_npz,
}


def _damaged(table: Path, error: Exception) -> UserError:
    why = " ".join(str(error).split())[:120] or type(error).__name__
    return UserError(f"{table} cannot be read ({why}): write the table anew, without Python objects in it")


def _matrix(table: Path, columns: dict[str, Any], name: str) -> tuple[Float[np.ndarray, "n size"], tuple[str, ...]]:
    """Return the numbers (n, size) of a column of lists, or of one column per entry, and the names of the entries.

    Raises UserError for a missing column, or sizes that do not fit.
    """
    entries = tuple(column.partition(".")[2] for column in columns if column.startswith(f"{name}."))
    if name not in columns and not entries:
        there = ", ".join(columns) or "none"
        raise UserError(
            f"{table} has no column {name} (its columns: {there}): give a list per row, or {name}.NAME columns"
        )
    if name in columns and entries:
        raise UserError(f"{table} has the columns {name} and {name}.{entries[0]}: give only one of the two forms")
    if not entries:
        return _numbers(table, name, columns[name], 2), ()
    return np.stack(
        [_numbers(table, f"{name}.{entry}", columns[f"{name}.{entry}"], 1) for entry in entries], -1
    ), entries


def _numbers(table: Path, name: str, values: Any, axes: int) -> np.ndarray:
    """Convert a column to 32-bit floats. Raises UserError for rows of several sizes, or non-numbers."""
    try:
        with np.errstate(over="ignore"):
            found = np.asarray(values, np.float32)
        if found.size and found.ndim != axes:
            raise ValueError
    except (TypeError, ValueError):
        wanted = "the same number of numbers" if axes == 2 else "one number"
        raise UserError(f"{table}: give {wanted} in every row of the column {name}") from None
    return found if found.size else np.zeros((len(found), 0)[:axes], np.float32)
