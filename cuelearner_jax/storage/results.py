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
| failed       | float | 1 once the lane stopped being finite: its metrics are null then  |
| all others   | float | metrics, for instance `reward`; a value that is not finite is null |

In the JSONL file, columns that stay the same are written once: a line `{"constants": {...}}` holds for all lines after
it, until the next such line (a run resumed on other hardware adds one). In Parquet they are ordinary columns.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.table import PathLike

SCHEMA = tables.Schema(
    stem="results",
    mark="step",
    required=("run", "task", "guidance", "labels", "seed", "step", "split", "config_hash"),
    strings=("run", "task", "guidance", "split", "config_hash", "commit", "versions", "hardware", "command"),
    integers=("labels", "seed", "step"),
    remedy="is damaged: restore it, or delete its folder and give --resume, which trains these lanes anew",
)
JSONL, PARQUET = SCHEMA.jsonl, SCHEMA.parquet
FAILED = "failed"  # the column that marks rows of lanes that have failed
LANE = ("guidance", "labels", "seed")  # what tells the lanes of a run apart
LaneKey = tuple[str, int, int]


class ResultsWriter(tables.TableWriter):
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
        super().__init__(folder, SCHEMA, constants)


def last_step(folder: PathLike) -> int:
    """Step of the newest complete row of a table that is still being written; 0 where there is none."""
    row = tables.last_row(folder, SCHEMA)
    return row["step"] if row else 0


def truncate_after(folder: PathLike, step: int) -> None:
    """Drops the rows past `step` and a torn last line; used before a run is resumed from the checkpoint of `step`.

    Args:
        folder: folder of the run, or its `results.jsonl`; without results nothing happens.
        step: environment steps of a seed at the checkpoint; rows at this step stay.
    """
    tables.truncate(folder, SCHEMA, keep=lambda row: row["step"] <= step)


def finish(folder: PathLike) -> Path:
    """Turns the JSONL table of a run that is done into Parquet and removes the JSONL; returns the Parquet file.

    Args:
        folder: folder of the run, or its `results.jsonl`. A table that is finished already is left as it is.

    Raises:
        UserError: if there is no table, a run without an evaluation, or it cannot be read.
    """
    return tables.finish(folder, SCHEMA)


def check_complete(folder: Path, seeds: np.ndarray, budgets: np.ndarray, steps: Sequence[int]) -> None:
    """Whether a table has one row of each lane at each of the steps; other steps are not looked at.

    Args:
        folder: folder of the run.
        seeds: of the lanes, (lanes,).
        budgets: their label budgets, (lanes,).
        steps: at which each was evaluated.

    Raises:
        UserError: rows are missing or there more than once, there is no table, or it cannot be read.
    """
    path = next((folder / name for name in (PARQUET, JSONL) if (folder / name).exists()), folder / JSONL)
    found: Counter[tuple[int, int, int]] = Counter()
    if path.exists():
        table = tables.read(path, SCHEMA)
        if table.num_rows:
            table = table.filter(pc.field("step").isin(list(steps)))
            found.update(zip(*(table[name].to_pylist() for name in ("seed", "labels", "step")), strict=True))
    lanes = [(int(seed), int(budget)) for seed, budget in zip(seeds, budgets, strict=True)]
    wanted = Counter((*lane, step) for lane in lanes for step in steps)
    if found == wanted:
        return
    wrong = sorted((wanted - found) or (found - wanted))
    raise UserError(
        f"{path} {'lacks' if wanted - found else 'has too many'} rows: {len(wrong)}, the first of seed {wrong[0][0]} "
        f"with {wrong[0][1]} labels at step {wrong[0][2]}; restore it, or delete {folder} and give --resume, which "
        "trains these lanes anew"
    )


def find(paths: PathLike | Sequence[PathLike], schema: tables.Schema = SCHEMA) -> list[Path]:
    """The results files at or below the given files or folders: one a run, whether it is done or still going.

    `schema`: of the tables that are meant. Raises UserError if a path does not exist, or has none below it.
    """
    paths = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        if not path.exists():
            raise UserError(f"{path} does not exist: give the folder of a run, or a folder that holds runs")
        files = [path] if path.is_file() else sorted([*path.rglob(schema.jsonl), *path.rglob(schema.parquet)])
        if not files:
            raise UserError(
                f"no {schema.stem} below {path}: expected a {schema.jsonl} or {schema.parquet} in it or in a folder "
                "below it"
            )
        for file in files:
            # Both exist only after a crash between writing one and removing the other, and then hold the same rows.
            whole = file.with_name(schema.parquet)
            file = whole if file.name == schema.jsonl and whole.exists() else file  # noqa: PLW2901
            found[file.resolve()] = file
    return list(found.values())


def read(paths: PathLike | Sequence[PathLike], task: str | None = None, schema: tables.Schema = SCHEMA) -> pa.Table:
    """Reads the results of any number of runs, done or still going, into one table.

    Args:
        paths: results files, folders of runs, or folders at any height above them.
        task: keeps the rows of this task only; needed where the runs are of several tasks.
        schema: of the tables that are meant.

    Returns:
        A table with the columns listed at the top of this module, and `folder`, the folder of the row's run; a column
        that some run lacks is null there.

    Raises:
        UserError: if a path is missing, holds no rows, is corrupt, or the runs are of several tasks.
    """
    files = find(paths, schema)
    parts = []
    for file in files:
        part = tables.read(file, schema)
        folder = pa.repeat(pa.scalar(file.parent.as_posix()), part.num_rows)
        parts.append(part.append_column("folder", folder))
    table = pa.concat_tables(parts, promote_options="permissive")
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
    others = (*SCHEMA.strings, *SCHEMA.integers, "wall_s", FAILED, "folder")
    return [name for name in table.column_names if name not in others]


def failures(table: pa.Table) -> dict[LaneKey, int]:
    """The lanes of a table of results that have failed, with the step of the first row that says so, in order."""
    if FAILED not in table.column_names:
        return {}
    marked = table.filter(pc.field(FAILED) == 1.0)
    first: dict[LaneKey, int] = {}
    for row in marked.select([*LANE, "step"]).sort_by("step").to_pylist():
        first.setdefault((row["guidance"], row["labels"], row["seed"]), row["step"])
    return dict(sorted(first.items()))


def lanes(table: pa.Table) -> int:
    """The number of lanes in a table of results."""
    return table.group_by(list(LANE)).aggregate([]).num_rows
