"""A run's tables: its results, and each guide's own performance while labels are collected.

`results.jsonl` grows during a run; `results.parquet` replaces it at the end. One row holds one evaluation of one
seed. `MEANINGS` describes the columns, as does the `description` in each column's metadata in Arrow and Parquet.

`guide.jsonl` and `guide.parquet` beside them evaluate uniform actions refined by a lane's guide. A lane's guide has a
row at every multiple of `--schedule.guide-eval-every` labels of its own, and at its last label.

A run appends the rows of a step, or of a round, before it saves that checkpoint; then no row is lost.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.table import PathLike

MEANINGS = {  # of columns, by name or pattern; the first that fits
    "run": "name of the run",
    "task": "name of the task",
    "guidance": 'kind of guidance: "none", "relative", ...',
    "labels": "label budget; 0 where the guidance takes no labels",
    "seed": "seed of the lane",
    "step": "environment steps taken by this seed so far",
    "split": 'episodes of the evaluation: "validation", "tuning" or "training"',
    "config_hash": "hash of the run's configuration",
    "wall_s": "seconds since the run started",
    "commit": "commit of this package that wrote the row",
    "versions": "versions of the libraries",
    "hardware": "devices of the run",
    "command": "command line of the run",
    "failed": "1 once the lane is no longer finite: its metrics are null from then on",
    "episodes": "episodes of the evaluation, or environments where steps count",
    "folder": "folder of the row's table; only in tables that were read",
    "asked": "labels asked for so far, answered or not: at most the budget",
    "round": "label rounds of the lanes trained with this lane so far",
    "*.*": "value of an option that varies in a sweep, as `scalars.eps_deg`",
    "*_each": "means of a metric over up to 20 groups of the evaluation's episodes",
    "guide_*": "a metric of the guide alone, without the agent; null where the guide was not measured",
    "train_*": "mean over training since the last evaluation: of the loss, of the reward, ...",
    "*": "a metric: mean over the evaluation's episodes, or steps; null where the value is not finite",
}
SCHEMA = tables.Schema(
    stem="results",
    required=("run", "task", "guidance", "labels", "seed", "step", "split", "config_hash"),
    strings=("run", "task", "guidance", "split", "config_hash", "commit", "versions", "hardware", "command", "folder"),
    integers=("labels", "seed", "step", "episodes"),
    lists=("_each",),
    meanings=MEANINGS,
    remedy="is damaged: restore it, or move its folder away and give --resume, which trains these lanes anew",
)
GUIDES = tables.Schema(
    stem="guide",
    required=(*SCHEMA.required, "asked", "round"),
    strings=SCHEMA.strings,
    integers=("labels", "seed", "step", "asked", "round"),
    meanings=MEANINGS,
    remedy=SCHEMA.remedy,
)
JSONL, PARQUET = SCHEMA.jsonl, SCHEMA.parquet
FAILED = "failed"  # column that marks the rows of failed lanes
LANE = ("guidance", "labels", "seed")  # columns that identify a lane of a run
SETTINGS = "*.*=*"  # pattern of folders of a sweep's settings, see `setting_name`


def check_complete(folder: Path, step: int, count: int, run: str) -> None:
    """Raise UserError unless a folder's tables are a run's, and its results have `count` rows up to a step.

    `run` is the key of the run, which tables of earlier versions lack. A missing table has no rows.
    """
    for schema in (GUIDES, SCHEMA):  # the results last: theirs are the rows that count
        rows = 0
        if path := schema.found_in(folder):
            table = tables.read(path, schema)
            if (tables.about_of(table) or {}).get("run", run) != run:
                raise UserError(f"{path} belongs to another run: put its own back")
            rows = table.filter(pc.field("step") <= step).num_rows if table.num_rows else 0
    if rows != count:
        advice = "restore its table, or move the folder away and give --resume, which trains these lanes anew"
        raise UserError(f"{folder} has {rows} of {count} results up to step {step}: {advice}")


def read(paths: PathLike | Sequence[PathLike], schema: tables.Schema = SCHEMA) -> pa.Table:
    """Read the results of any number of runs, finished or not, into one table.

    `paths`: results files, run folders, or folders at any height above them; a file that is given twice counts once.
    The table has the columns of `MEANINGS`. A column that a run lacks is null for that run.
    """
    parts: dict[Path, pa.Table] = {}
    for path in map(Path, [paths] if isinstance(paths, str | os.PathLike) else paths):
        files = [path] if path.is_file() else sorted([*path.rglob(schema.jsonl), *path.rglob(schema.parquet)])
        if not files:
            raise UserError(f"no {schema.stem} at or below {path}: give the folder of a run, or one that holds runs")
        for one in files:
            # Both exist only after a crash between writing one and removing the other; they then hold equal rows.
            file = (schema.found_in(one.parent) or one) if one.name == schema.jsonl else one
            if file.resolve() not in parts:
                part = tables.read(file, schema)
                folder = pa.repeat(pa.scalar(file.parent.as_posix()), part.num_rows)
                parts[file.resolve()] = part.append_column(schema.arrow_field("folder"), folder)
    table = pa.concat_tables(parts.values(), promote_options="permissive")
    if table.num_rows == 0 and schema is SCHEMA:
        raise UserError(f"no rows yet in {', '.join(map(str, parts))}: wait for the first evaluation")
    return table


def read_guides(paths: Sequence[PathLike]) -> pa.Table | None:
    """Read the tables of guides' own performance, as `read`; None where there are none yet."""
    there = [path for path in paths if any([*Path(path).rglob(GUIDES.jsonl), *Path(path).rglob(GUIDES.parquet)])]
    table = read(there, GUIDES) if there else None
    return table if table and table.num_rows else None


def metrics(table: pa.Table) -> list[str]:
    """Return the names of a results table's metric columns."""
    others = (*SCHEMA.strings, *SCHEMA.integers, "wall_s", FAILED, *settings(table))
    return [name for name in table.column_names if name not in others and not SCHEMA.is_list(name)]


def settings(table: pa.Table) -> list[str]:
    """Return the columns of options that vary in a sweep."""
    return sorted(name for name in table.column_names if "." in name)


def setting_name(setting: Mapping[str, float | str]) -> str:
    """Return the name of options' values, also of their folder: "scalars.eps_deg=2"."""
    return ",".join(f"{name}={str(value).removesuffix('.0')}" for name, value in setting.items())


def failures(table: pa.Table) -> dict[tuple[str, int, int], int]:
    """Return the failed lanes of a results table, each with the first step marked as failed, in order."""
    if FAILED not in table.column_names:
        return {}
    first = table.filter(pc.field(FAILED) == 1.0).group_by(list(LANE)).aggregate([("step", "min")]).to_pylist()
    return dict(sorted((tuple(row[name] for name in LANE), row["step_min"]) for row in first))
