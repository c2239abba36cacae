"""Label files: Parquet, one row a label, with what the numbers mean written into the file.

A file holds one set of labels, or one for each seed of a run.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cuelearner_jax.errors import UserError
from cuelearner_jax.types import Label

META = b"cuelearner"
CONVENTIONS = {
    "obs": "the task's observation at the question",
    "action": "unit vector asked about",
    "answer": "what the guidance model is to predict; relative: action turned by h * eps, less the action",
    "angles": "radians, counterclockwise positive",
}


class LabelFile(NamedTuple):
    """Label sets and where they come from."""

    task: dict[str, Any]  # {"name": ..., configuration of the task}
    answers: str
    eps_deg: float  # strength of the labels [deg]
    seeds: np.ndarray  # (labels,)
    labels: Label  # rows (labels, ...), in the order they were given


def write(path: Path, task: dict[str, Any], answers: str, eps_deg: float, seeds: np.ndarray, labels: Label) -> None:
    """Writes the labels that count. `seeds` (lanes,), `labels` (lanes, slots, ...). Replaces `path` in one step."""
    valid = np.asarray(labels.valid)
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[valid], labels)
    seed = np.broadcast_to(np.asarray(seeds)[:, None], valid.shape)[valid]
    columns = {"seed": pa.array(seed.astype(np.int64))}
    for name in ("obs", "action", "answer"):
        columns[name] = pa.array(list(getattr(rows, name)), pa.list_(pa.float32()))
    meta = {"task": task, "answers": answers, "eps_deg": float(eps_deg), "conventions": CONVENTIONS}
    table = pa.table(columns).replace_schema_metadata({META: json.dumps(meta).encode()})
    temporary = path.with_suffix(".tmp")
    pq.write_table(table, temporary, write_page_checksum=True)
    os.replace(temporary, path)


def read(path: Path) -> LabelFile:
    """Raises UserError if the file is missing or holds no labels."""
    if not path.is_file():
        raise UserError(f"no label file at {path}: give the path of a labels.parquet that a run or a person wrote")
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        meta = json.loads((table.schema.metadata or {})[META])
        columns = {name: np.array(table[name].to_pylist(), np.float32) for name in ("obs", "action", "answer")}
        seeds = np.array(table["seed"].to_pylist(), np.int64)
        labels = Label(**columns, valid=np.ones(len(seeds), bool))  # pyright: ignore[reportArgumentType]
        file = LabelFile(meta["task"], meta["answers"], float(meta["eps_deg"]), seeds, labels)
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is not a label file of cuelearner, or it is damaged: write it anew") from error
    if not len(seeds):
        raise UserError(f"{path} holds no labels: collect some first")
    return file


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
        if len(chosen) < budget:
            raise UserError(
                f"the label file has {len(chosen)} labels for seed {seed}, the budget is {budget}: "
                "lower --labels or collect more"
            )
        chosen = chosen[:budget]
        sets.append(jax.tree.map(lambda leaf, rows=chosen: _padded(leaf[rows], slots), file.labels))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *sets)


def _padded(rows: np.ndarray, slots: int) -> np.ndarray:
    return np.concatenate([rows, np.zeros((slots - len(rows), *rows.shape[1:]), rows.dtype)])
