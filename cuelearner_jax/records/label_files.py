"""Label files: one row a label, with what the numbers mean written into the file.

A label is what a teacher said of an action in a state: the answer, not what some model is to learn from it, so that one
file serves every kind of guidance that takes this form of answer. A file holds one set of labels, or one for each seed
of a run. `write` writes a whole file; `LabelWriter` one label at a time, each of which is safe once it is said.

| column | type           | meaning                                                  |
|--------|----------------|----------------------------------------------------------|
| seed   | int            | whose label it is                                        |
| obs    | list of floats | the task's observation at the question                   |
| action | list of floats | the action asked about                                   |
| answer | list of floats | what the teacher said; the file names the form of it     |
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa

from cuelearner_jax.errors import UserError
from cuelearner_jax.records import formats
from cuelearner_jax.records import table as tables
from cuelearner_jax.types import Label

SCHEMA = tables.Schema(
    stem="labels",
    mark="action",
    required=("seed", "obs", "action"),
    integers=("seed",),
    lists=("obs", "action", "answer", "target"),  # target: of files of format 0, in place of the answer
    remedy=formats.REMEDIES["labels"],
)
JSONL, PARQUET = SCHEMA.jsonl, SCHEMA.parquet
ROW = ("obs", "action", "answer")  # columns of lists
LISTED = 20  # seeds that a message names
CONVENTIONS = {
    "obs": "the task's observation at the question",
    "action": "unit vector asked about",
    "answer": "what the teacher said of the action, in the form that `answers` names",
    "eps_deg": "strength of an answer [deg], null where the form has none",
    "angles": "radians, counterclockwise positive",
}
TOLD = ("format", "task", "answers", "eps_deg")  # what must be the same for labels to share a file


class LabelFile(NamedTuple):
    """Label sets and where they come from."""

    task: dict[str, Any]  # {"name": ..., configuration of the task}
    answers: str  # name of the form of the answers, see `guidance.answers`
    eps_deg: float | None  # strength of an answer [deg]; None where the form has none
    seeds: np.ndarray  # (labels,)
    labels: Label  # rows (labels, ...), in the order they were given


class LabelWriter(tables.TableWriter):
    """Appends labels to `labels.jsonl` of a folder; each is on the disk when the call returns.

    Opening an existing file continues it: a torn last line, left by a crash, is dropped first, and a finished file
    (Parquet) becomes JSONL again.
    """

    def __init__(
        self, folder: Path, task: dict[str, Any], answers: str, eps_deg: float | None, meaning: str = ""
    ) -> None:
        """Opens the file, creating it and the folder where needed.

        Args:
            folder: where the file lies.
            task: {"name": ..., configuration of the task}.
            answers: form of the answers.
            eps_deg: strength of an answer [deg]; None where the form has none.
            meaning: of an answer's numbers, written into the file.

        Raises:
            UserError: the folder holds labels of something else, or they cannot be read; nothing has been changed.
        """
        about = _about(task, answers, eps_deg, meaning)
        there = next((folder / name for name in (PARQUET, JSONL) if (folder / name).exists()), None)
        self._widths: dict[str, int] = {}
        if there is not None:
            table, before = _told(there)
            if before is None and table.num_rows:
                raise formats.damaged("labels", there)
            differing = [] if before is None else [name for name in TOLD if before.get(name) != about[name]]
            if differing:
                raise UserError(f"{there} holds labels of another {', '.join(differing)}: give another folder")
            if table.num_rows:
                last = table.slice(table.num_rows - 1).to_pylist()[0]
                self._widths = {name: len(last[name]) for name in ROW}
        super().__init__(folder, SCHEMA, about=about)

    def append(self, *, seed: int, obs: np.ndarray, action: np.ndarray, answer: np.ndarray) -> None:
        """Appends one label.

        Args:
            seed: whose label it is.
            obs: the task's observation at the question, (obs,).
            action: the action asked about, (action,).
            answer: what the teacher said, (width,).

        Raises:
            ValueError: a number is not finite, or a width is not that of the labels before.
        """
        columns = {name: np.asarray(value, np.float32) for name, value in zip(ROW, (obs, action, answer), strict=True)}
        for name, value in columns.items():
            if value.shape != (self._widths.setdefault(name, value.size),):
                raise ValueError(f"{name} has the shape {value.shape}, expected ({self._widths[name]},)")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} is not finite: {value}")
        super().append(seed=int(seed), **columns)


def finish(folder: Path) -> Path:
    """Turns the labels of a `LabelWriter` into Parquet; returns that file. Raises UserError if there are none."""
    return tables.finish(folder, SCHEMA)


def write(
    path: Path,
    task: dict[str, Any],
    answers: str,
    eps_deg: float | None,
    seeds: np.ndarray,
    labels: Label,
    meaning: str = "",
) -> None:
    """Writes the labels that count as Parquet, replacing `path` in one step.

    Args:
        path: where to.
        task: {"name": ..., configuration of the task}.
        answers: form of the answers.
        eps_deg: strength of an answer [deg]; None where the form has none.
        seeds: of the lanes, (lanes,).
        labels: (lanes, slots, ...).
        meaning: of an answer's numbers, written into the file.
    """
    valid = np.asarray(labels.valid)
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[valid], labels)
    seed = np.broadcast_to(np.asarray(seeds)[:, None], valid.shape)[valid]
    columns = {"seed": pa.array(seed.astype(np.int64))}
    for name in ROW:
        columns[name] = pa.array(list(getattr(rows, name)), SCHEMA.type(name))
    tables.write(path, pa.table(columns), SCHEMA, about=_about(task, answers, eps_deg, meaning))


def read(path: Path) -> LabelFile:
    """The labels of a Parquet or JSONL file, of the current format or an older one.

    Raises:
        UserError: the file is missing, damaged, of a newer program, or holds no labels.
    """
    if not path.is_file():
        raise UserError(f"no label file at {path}: give the path of a labels.parquet that a run or a person wrote")
    table, told = _told(path)
    if not table.num_rows and told is not None:
        raise UserError(f"{path} holds no labels: collect some first")
    try:
        columns = {name: _array(table[name], name) for name in table.column_names}
        values = formats.upgrade("labels", {**(told or {}), "columns": columns}, path)
        columns, eps = values["columns"], values["eps_deg"]
        rows = {name: columns[name] for name in ROW}
        if any(array.ndim != 2 for array in rows.values()) or not isinstance(values["answers"], str):
            raise ValueError("every column holds one list a label, and the form of the answers is a name")
        labels = Label(**rows, valid=np.ones(table.num_rows, bool))  # pyright: ignore[reportArgumentType]
        named = dict(values["task"]), values["answers"]
        return LabelFile(*named, None if eps is None else float(eps), columns["seed"], labels)
    except (KeyError, TypeError, ValueError) as error:
        raise formats.damaged("labels", path) from error


def readable(path: Path) -> bool:
    """Is there a label file that is whole?"""
    try:
        read(path)
    except UserError:
        return False
    return True


def digest(path: Path) -> str:
    """What tells a file's contents from others of the same name."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def for_lanes(file: LabelFile, seeds: np.ndarray, budgets: np.ndarray, slots: int) -> Label:
    """Label sets of lanes, padded: rows (lanes, slots, ...).

    A file with one set serves every seed; with several, each lane gets its own seed's, up to its budget.

    Raises:
        UserError: a seed's labels are missing, or there are fewer than a lane's budget.
    """
    kept = np.unique(file.seeds)
    sets = []
    for seed, budget in zip(seeds, budgets, strict=True):
        own = kept[0] if len(kept) == 1 else seed
        chosen = np.flatnonzero(file.seeds == own)
        if own not in kept:
            raise UserError(
                f"the label file has labels for the seeds {_listed(kept)}, none for seed {seed}: "
                "give --first-seed and --seeds (train: --seed) of these, or the labels of another run"
            )
        if len(chosen) < budget:
            raise UserError(
                f"the label file has {len(chosen)} labels for seed {seed}, the budget is {budget}: "
                "lower --labels or collect more"
            )
        chosen = chosen[:budget]
        sets.append(jax.tree.map(lambda leaf, rows=chosen: _padded(leaf[rows], slots), file.labels))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *sets)


def _listed(seeds: np.ndarray) -> str:
    """Seeds in order, as a range where none between is absent."""
    if len(seeds) > 2 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds[:LISTED])) + (" and others" if len(seeds) > LISTED else "")


def _about(task: dict[str, Any], answers: str, eps_deg: float | None, meaning: str) -> dict[str, Any]:
    """What a file of labels says of itself."""
    return {
        "format": formats.FORMATS["labels"],
        "task": task,
        "answers": answers,
        "eps_deg": None if eps_deg is None else float(eps_deg),
        "conventions": {**CONVENTIONS, **({"answer": meaning} if meaning else {})},
    }


def _told(path: Path) -> tuple[pa.Table, dict[str, Any] | None]:
    """A file's table and what it says of itself, in whatever format; None: nothing."""
    table = tables.read(path, SCHEMA)
    try:
        return table, tables.about_of(table)
    except ValueError as error:
        raise formats.damaged("labels", path) from error


def _array(column: pa.ChunkedArray, name: str) -> np.ndarray:
    """A column as an array; ValueError if its lists are of several lengths."""
    return np.array(column.to_pylist(), np.int64 if name in SCHEMA.integers else np.float32)


def _padded(rows: np.ndarray, slots: int) -> np.ndarray:
    return np.concatenate([rows, np.zeros((slots - len(rows), *rows.shape[1:]), rows.dtype)])
