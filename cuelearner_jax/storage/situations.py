"""Recorded situations: observations, the proposed actions, and optionally a picture of each.

A folder holds `situations.parquet`, `.csv` or `.npz`, with pictures beside the table. A LeRobot dataset folder is read
too, see `storage.lerobot`. Columns of the table:

| column      | type                        | meaning                                                             |
|-------------|-----------------------------|---------------------------------------------------------------------|
| observation | list of floats (obs,)       | the policy's input; in CSV numbers separated by spaces             |
| action      | list of floats (action,)    | the proposed or executed action                                     |
| picture     | string                      | optional: a file in the folder, PNG or JPEG, or a clip, GIF or MP4  |
| text        | string                      | optional: what the robot was told to do                             |
| phase       | float, 0 to 1               | optional: the action's place in the chunk that its policy proposed  |
| hand        | list of floats (3,)         | optional: where the hand is, in the frame of the actions [m]        |
| effect      | list of floats (obs*action) | optional: change of the proposed action by one unit of each entry   |

With `phase`, the policy cannot be asked again: what it depends on, such as pictures, is not in the table. Observations
then end with the phase, the effects if there are any, and a slice `BASE`, the proposed action. The metadata
`cuelearner` of a Parquet file may have the bounds of the actions, `low` and `high`, and `hand`, the kinematics of a
robot whose hand's positions they are. Its `projections` (cameras, 3, 4) lead from these positions to shares of the
picture's width and height. Its `areas` (cameras, 4) are each camera's part of the picture: left, top, width, height.
Of a LeRobot dataset with pictures alone, observations are the actions.
In place of a list there may be one column per entry, `observation.NAME` or `action.NAME`, which names the entries.
Nothing in such a folder is executed: no pickles, and no path that leads out of the folder.
"""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float
from pyarrow import csv

from cuelearner_jax.environment import BASE, EFFECT, PROPOSED, Quantity
from cuelearner_jax.errors import UserError, format_numbers, format_value
from cuelearner_jax.storage import lerobot
from cuelearner_jax.storage.picture_files import Picture, read_picture

STEM = "situations"
SUFFIXES = (".parquet", ".csv", ".npz")
OBSERVATION, ACTION, PICTURE, TEXT, PHASE, HAND = "observation", "action", "picture", "text", "phase", "hand"
NUMBERS = {PHASE: 1, HAND: 2, EFFECT: 2}  # axes of the optional columns of numbers
MOST_SLICES = 64  # largest number of observation entries that each get a slice of their own


class Situations(NamedTuple):
    """Recorded situations, one per row."""

    observations: Float[np.ndarray, "n obs"]
    actions: Float[np.ndarray, "n action"]
    slices: tuple[Quantity, ...]  # of an observation
    entries: tuple[str, ...]  # names of an action's entries; empty: the recording names none
    digest: str  # of these situations
    # row -> its picture; None: that row has none. Raises UserError for a picture that cannot be read.
    picture: Callable[[int], Picture | None] = lambda row: None
    text: Callable[[int], str] = lambda row: ""  # row -> what the robot was told to do
    about: dict[str, Any] = {}  # the table's metadata  # noqa: RUF012
    hands: Float[np.ndarray, "n 3"] | None = None  # where the hand is; None: not known


def read_once(path: Path) -> Situations:
    """Read situations as `read` does, and those of an unchanged path only once."""
    files = (path, path / "meta/info.json", *(path / f"{STEM}{suffix}" for suffix in SUFFIXES))
    return _read_at(path, path.resolve(), tuple(file.stat().st_mtime_ns for file in files if file.exists()))


@lru_cache(maxsize=4)
def _read_at(path: Path, where: Path, when: tuple[int, ...]) -> Situations:
    return read(path)


def read(path: Path) -> Situations:
    """Read a folder of situations, its table alone, or a LeRobot dataset folder."""
    if (path / lerobot.INFO).is_file():
        observations, actions, names, entries, picture = lerobot.read(path)
        situations = _situations_of(path, observations, actions, names, entries)
        return situations._replace(picture=picture) if picture else situations
    table = _table_in(path)
    columns = _columns(table)
    own = (OBSERVATION, ACTION, PICTURE, TEXT, *NUMBERS)
    advice = f"name it {OBSERVATION}.NAME or {ACTION}.NAME"
    for name in columns:
        if name not in own and not name.startswith(("observation.", "action.")):
            raise UserError(f"{table} has an unknown column {format_value(name)}: {advice}, or leave it out")
    if any(isinstance(values, np.ndarray) and not values.ndim for values in columns.values()):
        raise UserError(f"{table} has a column of a single number: give one for each situation")
    if len({len(values) for values in columns.values()}) > 1:
        raise UserError(f"{table} has columns of several lengths: give an observation and an action for each situation")
    observations, names = _matrix(table, columns, OBSERVATION)
    actions, entries = _matrix(table, columns, ACTION)
    more = {name: _numbers(table, name, columns[name], axes) for name, axes in NUMBERS.items() if name in columns}
    phase, effect = more.get(PHASE), more.get(EFFECT)
    if effect is not None and (phase is None or effect.shape[1] != observations.shape[1] * actions.shape[1]):
        raise UserError(f"{table}: give a phase, and in effect as many numbers as observation times action entries")
    files, texts = (columns.get(name, [None] * len(actions)) for name in (PICTURE, TEXT))
    return _situations_of(table, observations, actions, names, entries, phase, effect)._replace(
        picture=lambda row: read_picture(table.parent, str(files[row])) if files[row] else None,
        text=lambda row: str(texts[row] or ""),
        about=_about(table, actions.shape[1]),
        hands=more.get(HAND),
    )


def _situations_of(
    path: Path,
    observations: np.ndarray,
    actions: np.ndarray,
    names: tuple[str, ...],
    entries: tuple[str, ...],
    phase: Float[np.ndarray, " n"] | None = None,
    effect: Float[np.ndarray, "n effect"] | None = None,
) -> Situations:
    """Build `Situations`. Raises UserError if there are none or a number is not finite."""
    size = observations.shape[1]
    slices = [Quantity(OBSERVATION, size, "1", "as recorded")]
    if len(names) == size <= MOST_SLICES:
        slices = [Quantity(name, 1, "1", "as recorded") for name in names]
    parts = [observations]
    if phase is not None:
        parts.append(phase[:, None])
        slices.append(Quantity(PHASE, 1, "1", "place in the chunk"))
    if effect is not None:
        parts.append(effect)
        slices.append(Quantity(EFFECT, effect.shape[1], "1", "of the state on the action", EFFECT))
    if phase is not None or size == 0 < len(observations):
        parts.append(actions)
        slices.append(Quantity(BASE, actions.shape[1], "1", "as recorded", PROPOSED))
    observations, contents = np.concatenate(parts, -1), hashlib.sha256()
    for name, rows in ((OBSERVATION, observations), (ACTION, actions)):
        if not rows.size:
            raise UserError(f"{path} holds no {name}s: record some situations first")
        if len(wrong := np.flatnonzero(~np.isfinite(rows).all(-1))):
            advice = "leave them out"
            raise UserError(f"{path}: {name}s of the rows {format_numbers(wrong.tolist())} are not finite: {advice}")
        contents.update(str(rows.shape).encode() + np.ascontiguousarray(rows).tobytes())
    contents.update("\n".join([quantity.name for quantity in slices] + ["", *entries]).encode())
    return Situations(observations, actions, tuple(slices), entries, contents.hexdigest()[:12])


def _about(table: Path, size: int) -> dict[str, Any]:
    """Return a table's metadata. Raises UserError where they do not fit its actions."""
    text = (pq.read_schema(table).metadata or {}).get(b"cuelearner") if table.suffix == ".parquet" else None
    if text is None:
        return {}
    try:
        about = json.loads(text)
        bounds = {name: np.asarray(about[name], float).reshape(size).tolist() for name in ("low", "high")}
        cameras = {name: np.asarray(about.get(name, []), float) for name in ("projections", "areas")}
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{table} has metadata that tell no bounds of {size} entries: write the table anew") from error
    return {**about, **bounds, **cameras}


def _table_in(path: Path) -> Path:
    """Return the only table in a folder, or the given table."""
    if path.is_file() and path.suffix in SUFFIXES:
        return path
    tables = [file for suffix in SUFFIXES if (file := path / f"{STEM}{suffix}").is_file()]
    if len(tables) != 1:
        there = f"holds {' and '.join(table.name for table in tables)}" if tables else "is no LeRobot dataset either"
        raise UserError(
            f"{path} {there if path.exists() else 'does not exist'}: give the path of one table, or a folder with one "
            f"{STEM}.parquet, .csv or .npz with the columns {OBSERVATION} and {ACTION}"
        )
    return tables[0]


def _columns(table: Path) -> dict[str, Any]:
    try:
        if table.suffix == ".npz":
            with np.load(table, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        rows: pa.Table = csv.read_csv(table) if table.suffix == ".csv" else pq.ParquetFile(table).read()
    except (pa.ArrowException, OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        why = " ".join(str(error).split())[:120]
        raise UserError(f"{table} cannot be read ({why}): write it anew, without Python objects in it") from error
    pairs = zip(rows.column_names, rows.columns, strict=True)
    columns: dict[str, Any] = {name.strip(): column.to_pylist() for name, column in pairs}
    if len(columns) < rows.num_columns:
        raise UserError(f"{table} has two columns of one name: give each column a name of its own")
    for name in columns.keys() & {OBSERVATION, ACTION} if table.suffix == ".csv" else ():
        columns[name] = [re.split(r"[\s;,]+", str(text).strip("[] ")) for text in columns[name]]
    return columns


def _matrix(table: Path, columns: dict[str, Any], name: str) -> tuple[Float[np.ndarray, "n size"], tuple[str, ...]]:
    """Return the numbers (n, size) of a column of lists, or of one column per entry, and the names of the entries."""
    entries = tuple(column.partition(".")[2] for column in columns if column.startswith(f"{name}."))
    if (name in columns) == bool(entries):
        advice = f"give one column {name} with a list per row, or {name}.NAME columns"
        raise UserError(f"{table} has the columns {', '.join(columns) or 'none'}: {advice}")
    if not entries:
        return _numbers(table, name, columns[name], 2), ()
    parts = [_numbers(table, f"{name}.{entry}", columns[f"{name}.{entry}"], 1) for entry in entries]
    return np.stack(parts, -1), entries


def _numbers(table: Path, name: str, values: Any, axes: int) -> np.ndarray:
    """Convert a column to 32-bit floats. Raises UserError for rows of several sizes, or non-numbers."""
    try:
        with np.errstate(over="ignore"):
            array = np.asarray(values, np.float32)
        if array.size and array.ndim != axes:
            raise ValueError
    except (TypeError, ValueError):
        what = "the same number of numbers" if axes == 2 else "one number"
        raise UserError(f"{table}: give {what} in every row of the column {name}") from None
    return array if array.size else np.zeros((len(array), 0)[:axes], np.float32)
