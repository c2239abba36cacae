"""A run's grid of lanes, and the run's description in config.json."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax import config as configuration
from cuelearner_jax import run_config
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import SPLITS
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.guides.base import Guide, NoGuide
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.storage import formats, label_files
from cuelearner_jax.storage.folders import CONFIG
from cuelearner_jax.task import Task

LARGEST_SEED = min(SPLITS.values())  # seeds and splits are folded into one key, so they must differ


@dataclass(frozen=True)
class Grid:
    """Values that vary among lanes. Guidance without labels runs once per seed, whatever the budgets."""

    guidance: tuple[str, ...]
    seeds: tuple[int, ...]
    labels: tuple[int, ...]

    def lanes(self, guidance: Guide | type[Guide]) -> tuple[np.ndarray, np.ndarray]:
        """Return (seeds, budgets) of the lanes of one kind, each (lanes,)."""
        budgets = self.labels if guidance.asks else (0,)
        seeds = np.array(self.seeds, np.int32)
        return np.tile(seeds, len(budgets)), np.repeat(np.array(budgets, np.int32), len(seeds))


def seeds_of(first: int, count: int) -> tuple[int, ...]:
    """Return `count` seeds from `first` on."""
    if count < 1:
        raise UserError(f"--seeds makes {count} seeds: give --seeds of at least 1, or a range such as 0:16")
    if first + count > LARGEST_SEED:
        raise UserError(f"--seeds is {first}:{first + count}: seeds are numbers from 0 to {LARGEST_SEED - 1}")
    return tuple(range(first, first + count))


def parse_seeds(words: str, first: int = 0) -> tuple[int, ...]:
    """Return the seeds of a number of them, from `first` on, or of a range such as 0:16, without its end."""
    start, _, number = words.rpartition(":")
    if not (start or "0").isdecimal() or not number.isdecimal() or words.startswith(":"):
        raise UserError(f"--seeds is {words!r}: give a number of seeds, or a range such as 0:16")
    return seeds_of(int(start), int(number) - int(start)) if start else seeds_of(first, int(number))


def with_control(grid: Grid) -> Grid:
    """Return a grid with the unguided agent in place of the label budget 0 of kinds that ask."""
    if 0 not in grid.labels or not any(guidances.find(kind).asks for kind in grid.guidance):
        return grid
    labels = tuple(budget for budget in grid.labels if budget)
    others = [kind for kind in grid.guidance if kind != NoGuide.name and (labels or not guidances.find(kind).asks)]
    return Grid((NoGuide.name, *others), grid.seeds, labels or (0,))


def check_grid(grid: Grid, adapts: bool = False) -> None:
    """Raise UserError for an invalid grid. `adapts`: a finished policy is adapted and no agent is trained."""
    kinds = [guidances.find(kind) for kind in grid.guidance]
    for kind in kinds:
        if kind.adapts_only and not adapts:
            raise UserError(f"guidance {kind.name!r} corrects a finished policy: use it with `cuelearner adapt` only")
    if not _all_differ(grid.guidance):
        raise UserError("--guidance: give each kind once, and at least one")
    if not _all_differ(grid.seeds) or not all(0 <= seed < LARGEST_SEED for seed in grid.seeds):
        raise UserError(f"seeds must be different numbers from 0 to {LARGEST_SEED - 1}, at least one")
    if any(kind.asks for kind in kinds):
        if not _all_differ(grid.labels):
            raise UserError("--labels: give each budget once, and at least one")
        if min(grid.labels) < 1:
            advice = "give --labels of at least 1, or, in training, 0 for the unguided agent"
            raise UserError(f"a label budget of {min(grid.labels)} teaches nothing: {advice}")


def _all_differ(values: tuple[Any, ...]) -> bool:
    return 0 < len(values) == len(set(values))


def describe(task: Task, config: RunConfig, grid: Grid, split: str, labels_from: Path | None = None) -> dict[str, Any]:
    """Return the contents of config.json, but for a shard's entry."""
    origin = {"from": task.origin} if task.origin else {}  # "from" is a Python keyword, so no field has this name
    return {
        "format": formats.FORMATS["config"],
        "task": {"name": task.name, **origin, **configuration.to_json(config.task)},
        **({"robot": task.robot} if task.robot else {}),
        **({"files": files} if (files := task.files(config.task)) else {}),
        **run_config.to_json(config),
        "grid": {"guidance": list(grid.guidance), "seeds": list(grid.seeds), "labels": list(grid.labels)},
        "split": split,
        "less_is_better": list(task.less_is_better),
        "labels_from": f"{labels_from.stem} {label_files.digest(labels_from)}" if labels_from else None,
        "total_steps": config.schedule.total_steps,
    }


def config_hash(contents: dict[str, Any]) -> str:
    """Return a short hash of what a lane's result depends on: a description without format and other lanes."""
    apart = ("format", "grid", "shard", "setting", "less_is_better")
    learned_from = {name: value for name, value in contents.items() if name not in apart}
    task = {name: value for name, value in contents["task"].items() if name != "from"}
    return configuration.digest({**learned_from, "task": task})


def run_key(contents: dict[str, Any], kind: str) -> str:
    """Return the hash by which a file knows its run, given the run's config.json, and its kind of guidance."""
    return configuration.digest({**contents, "kind": kind})


def load(folder: Path, find: Callable[[str], Task]) -> tuple[Task, RunConfig, Grid]:
    """Read a run folder's config.json; return its task, configuration and grid. Code that it names is not loaded.

    `find` returns the task of a name. Raises UserError if the folder is not a run's, or the task is unknown.
    """
    path = folder / CONFIG
    if not path.is_file():
        advice = "give the --out of a train or sweep, or code as module:NAME, which may load a model file"
        raise UserError(f"{folder} is not a run folder (it has no config.json): {advice}")
    values = formats.read("config", path)
    task, world = world_of(values["task"], find, path)
    config = run_config.from_json(world, values)
    grid = Grid(*(tuple(values["grid"][name]) for name in ("guidance", "seeds", "labels")))
    return task.on(values.get("robot")), config, grid


def world_of(values: dict[str, Any], find: Callable[[str], Task], path: Path) -> tuple[Task, Any]:
    """Return the task and the world (a configuration) that a folder's file describes."""
    origin = values.get("from")
    try:
        task = find(values["name"])
    except UserError as error:
        if origin is None:
            raise UserError(f"{path} belongs to an unknown task ({error})") from error
        why = f"{path} belongs to a task outside the package; its code is not loaded just because a file names it"
        raise UserError(f"{why}: add --task {origin} if you trust that code") from error
    return task, configuration.from_json(task.config, values)
