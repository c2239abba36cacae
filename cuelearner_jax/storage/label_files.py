"""Label files: one row per label, with the meaning of the numbers written into the file.

A label is what a teacher said of an action in a state: the answer, not a model's training target. So one file serves
every kind of guidance with this form of answers. A file holds one set of labels, or one for each seed of a run.
`write` writes a whole file; `LabelWriter` appends rows, each of which is on disk once the call returns.

| column  | type           | meaning                                                                              |
|---------|----------------|--------------------------------------------------------------------------------------|
| seed    | int            | whose label it is                                                                    |
| obs     | list of floats | the task's observation in the question                                               |
| action  | list of floats | the action asked about                                                               |
| answer  | list of floats | what the teacher said; the file names the form of it; absent where nothing was said  |
| item    | int            | people: number of the question, from 0                                               |
| said    | string         | people: one of `RESPONSES`; the last row of an item counts                            |
| seconds | float          | people: from the question on the screen to the answer [s]                            |
| who     | string         | people: a name                                                                       |
| when    | string         | people: time of the answer, ISO 8601 in UTC                                          |

Rows of simulated teachers have the first four columns. A row is never changed: an answer that is taken back stays, and
a later row of the same item says so. Readers return only the labels that still count. The head describes the space of
the actions, with names, words and unit of its cues, and the strength of all answers in that unit.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa

from cuelearner_jax import spaces
from cuelearner_jax.errors import UserError, format_numbers
from cuelearner_jax.spaces import Space
from cuelearner_jax.storage import formats
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.folders import differences
from cuelearner_jax.types import Label

ANSWERED, UNSURE, UNDONE = RESPONSES = ("answer", "unsure", "undone")  # an answer, "don't know", an answer taken back
ROW = ("obs", "action", "answer")  # columns that hold lists
PEOPLE = ("item", "said", "seconds", "who", "when")  # columns of a person's rows
SCHEMA = tables.Schema(
    stem="labels",
    required=("seed", "obs", "action"),
    strings=("said", "who", "when"),
    integers=("seed", "item"),
    lists=ROW,
    remedy=formats.REMEDIES["labels"],
)
JSONL, PARQUET = SCHEMA.jsonl, SCHEMA.parquet
CONVENTIONS = {
    "obs": "the task's observation at the question",
    "action": "asked about, of the space that `space` describes",
    "answer": "what the teacher said of the action, in the form that `answers` names",
    "eps": "strength of an answer in the unit of the space's cues, null where the form has none",
}
SHARED = ("format", "answers", "eps", "task", "space", "session")  # must be equal for labels to share a file


class People(NamedTuple):
    """Details of a person's labels beside the answers, (labels,) each."""

    item: np.ndarray  # number of the question
    seconds: np.ndarray  # taken for the answer [s]
    who: np.ndarray  # names
    when: np.ndarray  # ISO 8601


class LabelFile(NamedTuple):
    """Label sets and their origin."""

    task: dict[str, Any]  # {"name": ..., configuration of the task}
    answers: str  # name of the form of the answers, see `guidance.answers`
    space: Space  # of the actions
    eps: float | None  # strength of an answer, in the space's unit; None where the form has none
    seeds: np.ndarray  # (labels,)
    labels: Label  # rows (labels, ...) that still count, in the order they were given
    people: People | None = None  # None: the labels of a simulated teacher, or a merge that includes such labels
    session: dict[str, Any] | None = None  # settings of the page that asked, see `labelling.session`
    counts: dict[str, int] | None = None  # number of rows of each kind in `RESPONSES`, all rows counted
    seconds: float = 0.0  # what all rows took people [s]

    @property
    def budget(self) -> int:
        """The number of labels that each seed has at least."""
        return int(np.unique(self.seeds, return_counts=True)[1].min())


class LabelWriter(tables.TableWriter):
    """Appends rows to `labels.jsonl` in a folder, as `TableWriter` does; an existing file is continued."""

    def __init__(
        self, folder: Path, task: dict[str, Any], answers: str, space: Space, eps: float | None, **more: Any
    ) -> None:
        """Open the file, creating it and the folder where needed; labels of another kind there are refused unchanged.

        For the other arguments see `LabelFile` and `_head`.
        """
        head = _head(task, answers, space, eps, **more)
        if (there := found_in(folder)) and (before := _table_and_head(there)[1]):
            old, new = ({name: one.get(name) for name in SHARED} for one in (before, head))
            if (differing := next(differences(old, new), None)) is not None:
                raise UserError(f"{there} holds labels of another {differing}: give the same, or another --out")
        super().__init__(folder, SCHEMA, about=head)

    def append(
        self, *, seed: int, obs: np.ndarray, action: np.ndarray, answer: np.ndarray | None, **person: Any
    ) -> None:
        """Append one row, with columns of the names at the top of this module, or raise as `TableWriter.append`.

        Raises ValueError if a number is not finite: with such a row the file could not be read.
        """
        values = {name: value for name, value in zip(ROW, (obs, action, answer), strict=True) if value is not None}
        columns = {name: np.asarray(value, np.float32) for name, value in values.items()}
        for name, value in columns.items():
            if not np.isfinite(value).all():
                raise ValueError(f"{name} is not finite: {value}")
        super().append(seed=int(seed), **columns, **person)


def found_in(place: Path) -> Path | None:
    """Return the label file at a path, which may be its folder; None if there is none."""
    if not place.is_dir():
        return place if place.exists() else None
    return SCHEMA.found_in(place)


def history(path: Path) -> list[dict[str, Any]]:
    """Return every row of a person's file in the order of writing, overruled rows included; absent columns are None."""
    return _table_and_head(path)[0].to_pylist()


def write(
    path: Path,
    task: dict[str, Any],
    answers: str,
    space: Space,
    eps: float | None,
    seeds: np.ndarray,
    labels: Label,
    **more: Any,
) -> None:
    """Write the valid labels (lanes, slots, ...) of lanes with these seeds as Parquet, replacing `path` atomically.

    For the other arguments see `LabelFile` and `_head`.
    """
    valid = np.asarray(labels.valid)
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[valid], labels)
    seed = np.broadcast_to(np.asarray(seeds)[:, None], valid.shape)[valid]
    write_file(path, LabelFile(task, answers, space, eps, seed, rows), fresh=False, **more)


def write_file(path: Path, file: LabelFile, meaning: str = "", fresh: bool = True, **more: Any) -> None:
    """Write labels as a Parquet file, with the details of a person's labels.

    `meaning` and `more`: see `_head`. Raises UserError if the file exists although it should be `fresh`.
    """
    columns: dict[str, Any] = {"seed": file.seeds.astype(np.int64)}
    columns |= {name: list(np.asarray(getattr(file.labels, name), np.float32)) for name in ROW}
    if file.people is not None:
        person = {**file.people._asdict(), "said": [ANSWERED] * len(file.seeds)}
        columns |= {name: list(person[name]) for name in PEOPLE}
    head = _head(file.task, file.answers, file.space, file.eps, meaning, file.session, **more)
    tables.write(path, SCHEMA.table(columns, head), fresh)


def read(path: Path) -> LabelFile:
    """Read the labels that still count from a Parquet or JSONL file, or from the folder of one."""
    file = found_in(path)
    if file is None or not file.is_file():
        raise UserError(f"no label file at {path}: give the path of a labels.parquet that a run or a person wrote")
    table, head = _table_and_head(file)
    try:
        counts = dict(Counter(table["said"].to_pylist())) if "item" in table.column_names else None
        seconds = sum(filter(None, table["seconds"].to_pylist())) if counts else 0.0
        table = _standing(table) if counts else table
        if head is None or not table.num_rows:
            raise UserError(f"{file} holds no labels: collect some first")
        columns = {name: _array(table[name], name) for name in table.column_names}
        labels = Label(**{name: columns[name] for name in ROW}, valid=np.ones(table.num_rows, bool))  # pyright: ignore[reportArgumentType]
        eps = None if head["eps"] is None else float(head["eps"])
        about = {"task": dict(head["task"]), "answers": head["answers"], "space": spaces.from_json(head["space"])}
        people = People(*(columns[name] for name in People._fields)) if counts else None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise formats.damage_error("labels", file, error) from error
    rest = {"people": people, "session": head.get("session"), "counts": counts, "seconds": seconds}
    return LabelFile(**about, eps=eps, seeds=columns["seed"], labels=labels, **rest)


def _standing(table: pa.Table) -> pa.Table:
    """Return the rows of people that count: of each item the last, if it is an answer; in the order of items."""
    items = zip(table["seed"].to_pylist(), table["item"].to_pylist(), strict=True)
    last = {item: row for row, item in enumerate(items)}
    responses = table["said"].to_pylist()
    return table.take(pa.array([last[item] for item in sorted(last) if responses[last[item]] == ANSWERED], pa.int64()))


def digest(path: Path) -> str:
    """Return a short SHA-256 of the labels that still count and of the head, in whichever format they are stored."""
    table, _ = _table_and_head(found_in(path) or path)
    table = _standing(table) if "item" in table.column_names else table
    return tables.digest(table.select([name for name in table.column_names if name in ("seed", *ROW)]))[:12]


def for_lanes(file: LabelFile, seeds: np.ndarray, budgets: np.ndarray, slots: int) -> Label:
    """Return the lanes' label sets, padded: rows (lanes, slots, ...).

    A file with one set serves every seed; with several, each lane gets its own seed's set, up to its budget.
    """
    own_seeds, sets = np.unique(file.seeds), []
    for seed, budget in zip(seeds, budgets, strict=True):
        if not len(rows := np.flatnonzero(file.seeds == (own_seeds[0] if len(own_seeds) == 1 else seed))):
            why = f"the label file has labels for the seeds {format_numbers(own_seeds.tolist())}, none for seed {seed}"
            raise UserError(f"{why}: give --seeds (train: --seed) for these, or the labels of another run")
        if len(rows) < budget:
            there = f"the label file has {len(rows)} labels for seed {seed}, the budget is {budget}"
            raise UserError(f"{there}: lower --labels or collect more")
        pad = lambda leaf, own=rows[:budget]: np.pad(leaf[own], [(0, slots - len(own)), *[(0, 0)] * (leaf.ndim - 1)])  # noqa: E731
        sets.append(jax.tree.map(pad, file.labels))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *sets)


def _head(
    task: dict[str, Any],
    answers: str,
    space: Space,
    eps: float | None,
    meaning: str = "",
    session: dict[str, Any] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Return the head of a label file. `meaning`: of an answer's numbers. `more`: entries such as versions."""
    return {
        "format": formats.FORMATS["labels"],
        "task": task,
        "answers": answers,
        "space": space.to_json(),
        "eps": None if eps is None else float(eps),
        "conventions": {**CONVENTIONS, **({"answer": meaning} if meaning else {})},
        **({} if session is None else {"session": session}),
        **more,
    }


def _table_and_head(path: Path) -> tuple[pa.Table, dict[str, Any] | None]:
    """Return a file's table and head in the current format; None: the file has just begun."""
    table = tables.read(path, SCHEMA)
    head = tables.about_of(table)
    if head is not None or table.num_rows:
        formats.check("labels", head, path)
    return table, head


def _array(column: pa.ChunkedArray, name: str) -> np.ndarray:
    if name in SCHEMA.strings:
        return np.array([value or "" for value in column.to_pylist()])
    return np.array(column.to_pylist(), np.int64 if name in SCHEMA.integers else np.float32)
