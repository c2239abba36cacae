"""Open a run on disk, whole or in shards, with the lanes of its newest checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from cuelearner_jax.errors import UserError
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import shards
from cuelearner_jax.runs.grid import Grid, load, run_key
from cuelearner_jax.runs.training import restore_clock
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.storage.folders import CONFIG
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.terminal import console


class Piece(NamedTuple):
    """A folder with lanes of a run: all lanes, or those of some seeds."""

    folder: Path
    grid: Grid


@dataclass(frozen=True)
class RunLanes:
    """Lanes of one kind of guidance at the same step, from their newest checkpoints."""

    guidance: Guide
    seeds: np.ndarray  # (lanes,)
    budgets: np.ndarray  # (lanes,)
    policies: Any  # "params" and "guidance", which they act with, and "failed"; leading axis: lanes
    step: int


def open_run(folder: Path, find: Callable[[str], Task]) -> tuple[Task, RunConfig, Grid, tuple[Piece, ...]]:
    """Open the run in a folder, or the sweep whose shards lie below it (`--shard`).

    Returns the task, the configuration, the grid of all shards, and the folders. `find`: see `grid.load`.
    """
    whole = (folder / CONFIG).exists()
    folders = [] if whole else sorted(file.parent for file in folder.glob(f"shard-*-of-*/{CONFIG}"))
    runs = [load(one, find) for one in folders or [folder]]
    pieces = tuple(Piece(one, grid) for one, (_, _, grid) in zip(folders or [folder], runs, strict=True))
    first, of_seed = formats.read("config", pieces[0].folder / CONFIG), {}
    for piece in pieces:
        if names := shards.differing_options(first, formats.read("config", piece.folder / CONFIG)):
            raise UserError(
                f"{pieces[0].folder} and {piece.folder} are shards of different sweeps (they differ in {names}): "
                "give the folder of one of them"
            )
        for seed in piece.grid.seeds:
            if (other := of_seed.setdefault(seed, piece.folder)) != piece.folder:
                raise UserError(f"{other} and {piece.folder} both hold seed {seed}: delete the one that is a copy")
    task, config, grid = runs[0]
    return task, config, Grid(grid.guidance, tuple(of_seed), grid.labels), pieces


def lanes_of(task: Task, config: RunConfig, pieces: tuple[Piece, ...], kind: str, sweep: bool) -> list[RunLanes]:
    """Return the lanes of one kind of guidance, grouped by step, the furthest step first.

    A failed lane is restored at its last finite state. Missing or unfinished shards are named on the console, one line
    each. `sweep`: whether these are a sweep's shards, some of which may not have begun.
    """
    env = shape_of(task, config.task)
    guidance = config.guide_in(env, kind)

    def lane(key: PRNGKeyArray) -> dict[str, Any]:
        return {"params": config.agent_in(env).init(key)[0], "guidance": guidance.init(key)}

    like = jax.eval_shape(lane, jax.random.key(0))
    groups: dict[int, list[RunLanes]] = {}
    notes = shards.missing([piece.folder / CONFIG for piece in pieces]) if sweep else []
    for folder, grid in pieces:
        if not (folder / kind / "checkpoints").is_dir():
            notes.append(f"{folder}: no checkpoint of {kind} guidance, left out")
            continue
        seeds, budgets = grid.lanes(guidance)
        key = run_key(formats.read("config", folder / CONFIG), kind)
        with Checkpoints(folder / kind / "checkpoints", read_only=True, run=key) as store:
            policies, step = _restore(store, like, len(seeds))
        groups.setdefault(step, []).append(RunLanes(guidance, seeds, budgets, policies, step))
        if step < config.schedule.total_steps:
            notes.append(f"{folder}: {kind} guidance at step {step:,} of {config.schedule.total_steps:,}")
    if not groups:
        raise UserError(f"there is no checkpoint of {kind} guidance: train first, or choose another --guidance")
    for line in notes:
        console.print(line)
    return [_join(groups[step]) for step in sorted(groups, reverse=True)]


def _restore(store: Checkpoints, like: Any, lanes: int) -> tuple[dict[str, Any], int]:
    """Return what lanes act with (one lane: shapes `like`) and whether each has failed, and their training step."""
    clock, _, count, size = restore_clock(store)
    block = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((size, *leaf.shape), leaf.dtype), like)
    arrays = store.restore({"policy": [block] * count, "failed": [jax.ShapeDtypeStruct((size,), bool)] * count})
    blocks = [{**policy, "failed": mask} for policy, mask in zip(arrays["policy"], arrays["failed"], strict=True)]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:lanes], *blocks), int(clock.step)


def _join(parts: list[RunLanes]) -> RunLanes:
    """Join the lanes of several shards at one step."""
    if len(parts) == 1:
        return parts[0]
    seeds, budgets = (np.concatenate([getattr(part, name) for part in parts]) for name in ("seeds", "budgets"))
    policies = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(part.policies for part in parts))
    return RunLanes(parts[0].guidance, seeds, budgets, policies, parts[0].step)
