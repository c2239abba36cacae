"""The results table of a run: `results.jsonl` while it runs, `results.parquet` once it is done.

One row holds one evaluation of one seed:

| column       | type  | meaning                                                          |
|--------------|-------|------------------------------------------------------------------|
| run          | str   | name of the run                                                  |
| task         | str   | name of the task                                                 |
| guidance     | str   | "none", "relative", "heuristic", ...                             |
| labels       | int   | label budget, 0 where the guidance takes no labels               |
| seed         | int   | seed of the lane                                                 |
| step         | int   | environment steps that this seed has taken                       |
| split        | str   | "validation" or "training"                                       |
| config_hash  | str   | hash of the configuration of the run                             |
| wall_s       | float | seconds since the run started                                    |
| commit, versions, hardware, command | str | where the row comes from (see `provenance`)     |
| all others   | float | metrics, for instance `reward`; a value that is not finite is null |

In the JSONL file, columns that stay the same are written once: a line `{"constants": {...}}` holds for all lines after
it, until the next such line (a run resumed on other hardware adds one). In Parquet they are ordinary columns.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cuelearner_jax.errors import UserError

JSONL = "results.jsonl"
PARQUET = "results.parquet"
TAIL = 1 << 16  # more than the longest row [bytes]
REQUIRED = ("run", "task", "guidance", "labels", "seed", "step", "split", "config_hash")
STRINGS = ("run", "task", "guidance", "split", "config_hash", "commit", "versions", "hardware", "command")
INTEGERS = ("labels", "seed", "step")

PathLike = str | os.PathLike[str]
Row = dict[str, Any]


class ResultsWriter:
    """Appends rows to the JSONL file of one run; every append is on the disk when the call returns.

    Opening an existing file continues it: a torn last line, left by a crash, is dropped first, and a table that was
    already finished (Parquet) becomes JSONL again. Use `truncate_after` before that to go back to a checkpoint. A run
    should append the rows of a step before it saves the checkpoint of that step; then no row is lost.
    """

    def __init__(self, folder: PathLike, **constants: str | int | float) -> None:
        """Opens `folder/results.jsonl`, creating both where needed.

        Args:
            folder: folder of the run.
            constants: columns with one value for all rows to come, for instance `run`, `task` and `**provenance()`.
        """
        self.path = Path(folder) / JSONL
        self._columns = set(constants)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        _reopen(self.path)
        header = {name: _plain(value) for name, value in constants.items()}
        last = _rewrite(self.path, keep=lambda row: True) if self.path.exists() else None
        self._file = self.path.open("a", encoding="utf-8")
        if header != last:
            self._write([{"constants": header}])

    def append(self, **columns: Any) -> None:
        """Appends one row for each lane.

        Args:
            columns: scalars, which hold for all lanes, or arrays of shape (lanes,); all arrays of one length. For
                instance `append(step=1000, split="validation", seed=seeds, labels=budgets, reward=rewards)`.

        Raises:
            ValueError: if a required column is missing or the lengths differ.
        """
        missing = [name for name in REQUIRED if name not in columns and name not in self._columns]
        if missing:
            raise ValueError(f"a row of results needs the columns {', '.join(missing)}")
        # tolist() turns NumPy and JAX values into plain Python ones, in one transfer for each column.
        values = {name: np.asarray(value).tolist() for name, value in columns.items()}
        lengths = {len(value) for value in values.values() if isinstance(value, list)}
        if len(lengths) > 1:
            raise ValueError(f"columns of one append must have one length, got {sorted(lengths)}")
        lanes = lengths.pop() if lengths else 1
        self._write(
            {name: _plain(value[lane] if isinstance(value, list) else value) for name, value in values.items()}
            for lane in range(lanes)
        )

    def close(self) -> None:
        """Closes the file; the table stays JSONL until `finish`."""
        self._file.close()

    def __enter__(self) -> ResultsWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, lines: Iterable[Row]) -> None:
        self._file.write("".join(json.dumps(line, allow_nan=False) + "\n" for line in lines))
        self._file.flush()
        os.fsync(self._file.fileno())


def last_step(folder: PathLike) -> int:
    """Step of the newest complete row of a table that is still being written; 0 where there is none."""
    try:
        with (Path(folder) / JSONL).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            lines = file.read().split(b"\n")[:-1]
    except FileNotFoundError:
        return 0
    return json.loads(lines[-1]).get("step", 0) if lines else 0


def truncate_after(folder: PathLike, step: int) -> None:
    """Drops the rows past `step` and a torn last line; used before a run is resumed from the checkpoint of `step`.

    Args:
        folder: folder of the run, or its `results.jsonl`; without results nothing happens.
        step: environment steps of a seed at the checkpoint; rows at this step stay.
    """
    path = _jsonl(folder)
    _reopen(path)
    if path.exists():
        _rewrite(path, keep=lambda row: row["step"] <= step)


def finish(folder: PathLike) -> Path:
    """Turns the JSONL table of a run that is done into Parquet and removes the JSONL; returns the Parquet file.

    Args:
        folder: folder of the run, or its `results.jsonl`. A table that is finished already is left as it is.

    Raises:
        UserError: if there is no table or it cannot be read.
    """
    path = _jsonl(folder)
    target = path.with_name(PARQUET)
    if path.exists():
        table = _read_file(path)
        if table.num_rows == 0:
            raise UserError(f"{path} has no rows: a run without an evaluation cannot be finished")
        temporary = target.with_name(target.name + ".tmp")
        with temporary.open("wb") as file:
            pq.write_table(table, file, compression="zstd")
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
        path.unlink()
    elif not target.exists():
        raise UserError(f"no results in {path.parent}: expected {JSONL} or {PARQUET}")
    return target


def find(paths: PathLike | Sequence[PathLike]) -> list[Path]:
    """The results files at or below the given files or folders: one a run, whether it is done or still going.

    Raises:
        UserError: if a path does not exist, or has no results below it.
    """
    paths = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        if not path.exists():
            raise UserError(f"{path} does not exist: give the folder of a run, or a folder that holds runs")
        files = [path] if path.is_file() else sorted([*path.rglob(JSONL), *path.rglob(PARQUET)])
        if not files:
            raise UserError(f"no results below {path}: expected a {JSONL} or {PARQUET} in it or in a folder below it")
        for file in files:
            # Both exist only after a crash between writing one and removing the other, and then hold the same rows.
            whole = file.with_name(PARQUET)
            file = whole if file.name == JSONL and whole.exists() else file  # noqa: PLW2901
            found[file.resolve()] = file
    return list(found.values())


def read(paths: PathLike | Sequence[PathLike], task: str | None = None) -> pa.Table:
    """Reads the results of any number of runs, done or still going, into one table.

    Args:
        paths: results files, folders of runs, or folders at any height above them.
        task: keeps the rows of this task only; needed where the runs are of several tasks.

    Returns:
        A table with the columns listed at the top of this module, and `folder`, the folder of the row's run; a column
        that some run lacks is null there.

    Raises:
        UserError: if a path is missing, holds no rows, is corrupt, or the runs are of several tasks.
    """
    files = find(paths)
    tables = []
    for file in files:
        part = _read_file(file)
        folder = pa.repeat(pa.scalar(file.parent.as_posix()), part.num_rows)
        tables.append(part.append_column("folder", folder))
    table = pa.concat_tables(tables, promote_options="permissive")
    if table.num_rows == 0:
        raise UserError(f"no rows yet in {', '.join(map(str, files))}: wait for the first evaluation")
    tasks = sorted(set(table["task"].to_pylist()))
    if task is not None:
        if task not in tasks:
            raise UserError(f"no results of the task {task!r}: there are results of {', '.join(tasks)}")
        table = table.filter(pc.field("task") == task)
    elif len(tasks) > 1:
        raise UserError(f"results of several tasks ({', '.join(tasks)}) cannot be mixed: choose one of them")
    return table


def metrics(table: pa.Table) -> list[str]:
    """The names of the metric columns of a table of results."""
    return [name for name in table.column_names if name not in (*STRINGS, *INTEGERS, "wall_s", "folder")]


def _plain(value: Any) -> Any:
    """A JSON value: strict JSON has no NaN and no infinity, so they become null; a success is 1.0, not true."""
    value = value.item() if isinstance(value, np.generic) else value
    value = float(value) if isinstance(value, bool) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _jsonl(path: PathLike) -> Path:
    path = Path(path)
    return path.with_name(JSONL) if path.name in (JSONL, PARQUET) else path / JSONL


def _lines(path: Path) -> Iterator[Row]:
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
        if not isinstance(parsed, dict) or not ("constants" in parsed or "step" in parsed):
            raise UserError(f"{path}, line {number}, is not a row of results: repair or remove this line")
        yield parsed


def _rewrite(path: Path, keep: Callable[[Row], bool]) -> Row | None:
    """Rewrites a JSONL file with the rows to keep, atomically; returns the constants that hold at its end."""
    constants = None
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("w", encoding="utf-8") as file:
        for line in _lines(path):
            constants = line.get("constants", constants)
            if "constants" in line or keep(line):
                file.write(json.dumps(line) + "\n")
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    return constants


def _reopen(path: Path) -> None:
    """Turns a finished table back into JSONL, so that a run can be continued."""
    whole = path.with_name(PARQUET)
    if not whole.exists():
        return
    if not path.exists():
        temporary = path.with_name(path.name + ".tmp")
        with temporary.open("w", encoding="utf-8") as file:
            for row in _read_file(whole).to_pylist():
                file.write(json.dumps({name: value for name, value in row.items() if value is not None}) + "\n")
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    whole.unlink()


def _type(name: str) -> pa.DataType:
    return pa.string() if name in STRINGS else pa.int64() if name in INTEGERS else pa.float64()


def _read_file(path: Path) -> pa.Table:
    """One results file as a table with the types of this module; no rows, no columns where a run has just begun.

    Raises:
        UserError: if the file is corrupt or is no table of results.
    """
    if path.suffix != ".parquet" and not path.exists():
        path = path.with_name(PARQUET)  # the run was finished since the file was found
    try:
        table = pa.table(_columns(path)) if path.suffix != ".parquet" else pq.read_table(path)
        table = table.cast(pa.schema([(name, _type(name)) for name in table.column_names]))
    except (OSError, TypeError, pa.ArrowException) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise UserError(f"{path} is corrupt: restore it or run again ({reason})") from error
    missing = [name for name in REQUIRED if name not in table.column_names]
    if missing and table.num_rows:
        raise UserError(f"{path} lacks the columns {', '.join(missing)}: it is not a table of results of this package")
    return table


def _columns(path: Path) -> dict[str, pa.Array]:
    """The columns of a JSONL file, constants included."""
    constants: Row = {}
    columns: dict[str, list[Any]] = {}
    count = 0
    for line in _lines(path):
        if "constants" in line:
            constants = line["constants"]
            continue
        for name, value in (constants | line).items():
            column = columns.setdefault(name, [])
            column.extend([None] * (count - len(column)))  # a column that earlier rows lacked
            column.append(value)
        count += 1
    return {name: pa.array(column + [None] * (count - len(column)), _type(name)) for name, column in columns.items()}
