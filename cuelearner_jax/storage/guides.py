"""How good guides are by themselves while they are asked labels: `guide.jsonl`, `guide.parquet` once a run is done.

It lies beside the results and is kept in the same way. One row holds one evaluation of one lane's guide, that is of
uniform actions under its guidance:

| column     | type  | meaning                                                                             |
|------------|-------|-------------------------------------------------------------------------------------|
| labels     | int   | label budget of the lane, as in the results                                         |
| asked      | int   | labels asked for so far, answered or not: at most the budget                        |
| seed       | int   | seed of the lane                                                                    |
| step       | int   | environment steps that this seed has taken: 0 in the first instalment               |
| round      | int   | label rounds of the lanes trained with it so far: what a resumed run goes back by   |
| failed     | float | 1 once the lane stopped being finite: its metrics are null then                     |
| guide_...  | float | metrics, for instance `guide_reward`; a value that is not finite is null            |

and `run`, `task`, `guidance`, `split`, `config_hash`, `wall_s`, `commit`, `versions`, `hardware`, `command` as in the
results. A lane has a row at every multiple of `--schedule.guide-eval-every` labels of its own and where its share of an
instalment ends, so the last one is of all its labels.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import pyarrow as pa

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import results
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.table import PathLike

SCHEMA = tables.Schema(
    stem="guide",
    mark="asked",
    required=(*results.SCHEMA.required, "asked", "round"),
    strings=results.SCHEMA.strings,
    integers=(*results.SCHEMA.integers, "asked", "round"),
    remedy=results.SCHEMA.remedy,
)
JSONL, PARQUET = SCHEMA.jsonl, SCHEMA.parquet
Row = tuple[int, int, int]  # seed, labels, asked


class GuideWriter(tables.TableWriter):
    """Appends rows to `guide.jsonl` of one run, as `results.ResultsWriter` does to its table.

    A run should append the rows of a round before it saves the checkpoint of that round; then no row is lost.
    """

    def __init__(self, folder: PathLike, **constants: str | int | float) -> None:
        """Opens the table of a folder, creating both where needed; `constants`: columns with one value."""
        super().__init__(folder, SCHEMA, constants)


def truncate_after(folder: PathLike, rounds: int) -> None:
    """Drops the rows past so many rounds; used before a run is resumed from a checkpoint that has made these."""
    tables.truncate(folder, SCHEMA, keep=lambda row: row["round"] <= rounds)


def finish(folder: PathLike) -> Path:
    """Turns the JSONL table of a run that is done into Parquet. Raises UserError if there is none or it is damaged."""
    return tables.finish(folder, SCHEMA)


def check_complete(folder: Path, rounds: int, rows: Iterable[Row]) -> None:
    """Whether the table of a folder has each of these rows once, and no other, up to so many rounds.

    Raises:
        UserError: rows are missing or there more than once, there is no table, or it cannot be read.
    """
    path = next((folder / name for name in (PARQUET, JSONL) if (folder / name).exists()), folder / JSONL)
    wanted, found = Counter(rows), Counter()
    if path.exists() and (table := tables.read(path, SCHEMA)).num_rows:
        columns = [table[name].to_pylist() for name in ("seed", "labels", "asked", "round")]
        found.update(tuple(row) for *row, number in zip(*columns, strict=True) if number <= rounds)
    if found == wanted:
        return
    wrong = sorted((wanted - found) or (found - wanted))
    raise UserError(
        f"{path} {'lacks' if wanted - found else 'has too many'} rows: {len(wrong)}, the first of seed {wrong[0][0]} "
        f"with {wrong[0][1]} labels after {wrong[0][2]} of them; restore it, or delete {folder} and give --resume, "
        "which trains these lanes anew"
    )


def read_guides(paths: PathLike | Sequence[PathLike], task: str | None = None) -> pa.Table | None:
    """Reads the guides' quality of any number of runs, done or still going, into one table.

    Args:
        paths: folders of runs, or folders at any height above them.
        task: keeps the rows of this task only; needed where the runs are of several tasks.

    Returns:
        A table with the columns listed at the top of this module, and `folder`, the folder of the row's run; None where
        no run has one: it asked for no labels, or is of before there were such tables.

    Raises:
        UserError: if a path is missing, a table holds no rows or is corrupt, or the runs are of several tasks.
    """
    paths = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    for path in map(Path, paths):
        if not path.exists():
            raise UserError(f"{path} does not exist: give the folder of a run, or a folder that holds runs")
    there = [path for path in paths if any(next(Path(path).rglob(name), None) for name in (JSONL, PARQUET))]
    return results.read(there, task, SCHEMA) if there else None
