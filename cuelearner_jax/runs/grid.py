"""What a run is and the folder it lives in: the grid of lanes, config.json, and what may be done to a folder.

Folder of a run:

    config.json                  everything that determines the results
    .lock                        held by the process that writes here
    <guidance>/checkpoints/      the newest states
    <guidance>/labels.parquet    what the teacher answered
    <guidance>/results.jsonl     one row a seed and evaluation; results.parquet once done
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax import config as configuration
from cuelearner_jax.config import RunConfig
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import SPLITS
from cuelearner_jax.guidance import registry as guidances
from cuelearner_jax.records import label_files
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.task import ORIGIN, Task
from cuelearner_jax.types import Guidance

LOCK = ".lock"  # says which process writes in a run's folder; left behind empty
LARGEST_SEED = min(SPLITS.values())  # seeds and splits are folded into one key


@dataclass(frozen=True)
class Grid:
    """What is varied. Guidance without labels is run once a seed, whatever the budgets."""

    guidance: tuple[str, ...]
    seeds: tuple[int, ...]
    labels: tuple[int, ...]

    def lanes(self, guidance: Guidance) -> tuple[np.ndarray, np.ndarray]:
        """(seeds, budgets) of one kind's lanes, each (lanes,)."""
        budgets = self.labels if guidance.asks else (0,)
        pairs = [(seed, budget) for budget in budgets for seed in self.seeds]
        return np.array([p[0] for p in pairs], np.int32), np.array([p[1] for p in pairs], np.int32)


def check_grid(grid: Grid) -> None:
    """Raises UserError for a grid that makes no sense."""
    for kind in grid.guidance:
        if kind not in guidances.KINDS:
            raise UserError(f"unknown guidance {kind!r}: choose among {', '.join(guidances.KINDS)}")
    if not grid.guidance or len(set(grid.guidance)) < len(grid.guidance):
        raise UserError("--guidance: give each kind once, and at least one")
    if not grid.seeds or len(set(grid.seeds)) < len(grid.seeds) or not all(0 <= s < LARGEST_SEED for s in grid.seeds):
        raise UserError(f"seeds must be different numbers from 0 to {LARGEST_SEED - 1}: give --seeds and --first-seed")
    if "relative" in grid.guidance:
        if not grid.labels or len(set(grid.labels)) < len(grid.labels):
            raise UserError("--labels: give each budget once, and at least one")
        if min(grid.labels) < 1:
            raise UserError(
                f"a label budget of {min(grid.labels)} teaches nothing: give --labels of at least 1, "
                "and --guidance none for the unguided agent"
            )


def describe(
    task: Task,
    config: RunConfig,
    grid: Grid,
    split: str,
    labels_from: Path | None = None,
    shard: Shard | None = None,
) -> dict[str, Any]:
    """The contents of config.json."""
    origin = {"from": task.origin} if task.origin else {}  # no field of a configuration can be called so
    return {
        "task": {"name": task.name, **origin, **configuration.to_json(config.task)},
        "sizes": configuration.to_json(config.sizes),
        "scalars": configuration.to_json(config.scalars),
        "schedule": configuration.to_json(config.schedule),
        "grid": {"guidance": list(grid.guidance), "seeds": list(grid.seeds), "labels": list(grid.labels)},
        "split": split,
        "labels_from": f"{labels_from.name} {label_files.digest(labels_from)}" if labels_from else None,
        "total_steps": config.schedule.total_steps,
        **({"shard": list(shard)} if shard else {}),
    }


def load(folder: Path, find: Callable[[str], Task]) -> tuple[Task, RunConfig, Grid]:
    """What a run folder's config.json says.

    Args:
        folder: of the run.
        find: the task of a name; raises UserError for one that is not known. Code that the file names is never loaded.

    Raises:
        UserError: it is no run folder, or of a task that is not known.
    """
    path = folder / "config.json"
    if not path.is_file():
        raise UserError(f"{folder} is no run folder (it has no config.json): give the --out of a train or sweep")
    try:
        values = json.loads(path.read_text())
        name, origin = values["task"].pop("name"), values["task"].pop("from", None)
        if origin is not None and not ORIGIN.fullmatch(origin):
            raise ValueError(f"{origin!r} names no code")
        task = _known(find, name, origin, path)
        config = RunConfig(
            configuration.from_json(task.config, values["task"]),
            configuration.from_json(configuration.Sizes, values["sizes"]),
            configuration.from_json(configuration.Scalars, values["scalars"]),
            configuration.from_json(configuration.Schedule, values["schedule"]),
        )
        grid = Grid(*(tuple(values["grid"][name]) for name in ("guidance", "seeds", "labels")))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} is damaged or of another program: restore it or train anew") from error
    return task, config, grid


def _known(find: Callable[[str], Task], name: str, origin: str | None, path: Path) -> Task:
    """The task of a run. Raises UserError if it is not known, saying how one from outside becomes so."""
    try:
        return find(name)
    except UserError as error:
        if origin is None:
            raise UserError(f"{path} is of a task that is not here ({error})") from error
        raise UserError(
            f"{path} is of a task from outside, whose code is not loaded because a file names it: "
            f"add --task {origin} if you trust that code"
        ) from error


def in_use(out: Path) -> bool:
    """Is there anything at `out`, the mark of a process that writes there apart?"""
    return out.exists() and (not out.is_dir() or any(entry.name != LOCK for entry in out.iterdir()))


def check_folder(out: Path, described: dict[str, Any], resume: bool, overwrite: bool) -> None:
    """Raises UserError unless `out` may be used as asked."""
    if resume and overwrite:
        raise UserError("--resume continues a run and --overwrite deletes it: give one of them")
    used = in_use(out)
    ours = (out / "config.json").is_file()
    if resume:
        if not ours:
            raise UserError(f"nothing to resume in {out}: give the --out of an interrupted run, or leave out --resume")
        try:
            before = json.loads((out / "config.json").read_text())
            differing = sorted(_differences(before, described))
        except (ValueError, TypeError) as error:  # no JSON, or JSON of something else
            raise UserError(f"{out / 'config.json'} is damaged: restore it or start anew with --overwrite") from error
        if differing:
            raise UserError(
                f"{out} was run with another {', '.join(differing[:4])}: give the same options, or another --out"
            )
    elif used and not overwrite:
        raise UserError(f"{out} is not empty: give --resume to go on, --overwrite to delete it, or another --out")
    elif used and not ours:
        raise UserError(f"{out} is not a run folder, so --overwrite will not delete it: give another --out")


def _differences(before: dict[str, Any], now: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for name in {**before, **now}:
        if f"{prefix}{name}" == "task.from":  # where a task's code lies changes nothing in it
            continue
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from _differences(old, new, f"{prefix}{name}.")
        elif old != new:
            yield prefix + name


@contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Makes a run's folder and keeps it for this process alone; it is free again however the process ends.

    The lock is on a file, not on the folder: that is what NFS passes on between machines.

    Raises UserError if another process has it.
    """
    out.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(out / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise UserError(f"{out} is being written by another process: wait for it, or give another --out") from None
    try:
        yield
    finally:
        os.close(descriptor)


def prepare_folder(out: Path, described: dict[str, Any], clean: bool) -> None:
    """Makes the folder and writes config.json, if it is not there; with `clean`, nothing else is left in it."""
    out.mkdir(parents=True, exist_ok=True)
    for entry in out.iterdir() if clean else ():
        if entry.name == LOCK:
            continue
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    if not (out / "config.json").exists():
        temporary = out / "config.tmp"  # in one step, so that a crash leaves no half of it
        temporary.write_text(json.dumps(described, indent=1) + "\n")
        temporary.replace(out / "config.json")
