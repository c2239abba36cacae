"""Open a run on disk, whole or in shards, with the lanes of its newest checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from cuelearner_jax.errors import UserError
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import shards
from cuelearner_jax.runs.grid import Grid, load, run_key
from cuelearner_jax.runs.training import restore_clock
from cuelearner_jax.storage import formats, results
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.storage.folders import CONFIG
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.terminal import console


class Piece(NamedTuple):
    """A folder with lanes of a run: all lanes, or those of some seeds."""

    folder: Path
    grid: Grid


class Block(NamedTuple):
    """Lanes of one kind of guidance at one step, and the policies that they act with."""

    guidance: str
    seeds: np.ndarray  # (lanes,)
    budgets: np.ndarray  # (lanes,)
    bounds: np.ndarray  # (lanes,), in the space's unit; 0: no bound
    step: int
    policy: Any  # a block, or `Common`
    failed: np.ndarray  # (lanes,) bool

    def lanes(self, mask: np.ndarray) -> Block:
        """Return the lanes of a mask (lanes,)."""
        if mask.all():
            return self
        columns = {name: getattr(self, name)[mask] for name in ("seeds", "budgets", "bounds", "failed")}
        return self._replace(**columns, policy=self.policy.lane(np.flatnonzero(mask)))


def open_run(folder: Path, find: Callable[[str], Task]) -> tuple[Task, RunConfig, Grid, tuple[Piece, ...]]:
    """Open the run in a folder, or the sweep whose shards lie below it (`--shard`).

    Returns the task, the configuration, the grid of all shards, and the folders. `find`: see `grid.load`.
    """
    folders = [folder]
    if not (folder / CONFIG).exists():
        folders = sorted(file.parent for file in folder.glob(f"shard-*-of-*/{CONFIG}")) or folders
        if settings := sorted(folder.glob(results.SETTINGS)):
            raise UserError(f"{folder} holds {len(settings)} runs of a grid of settings: give one, as {settings[0]}")
    task, config, grid = load(folders[0], find)
    first, of_seed, pieces = formats.read("config", folders[0] / CONFIG), {}, []
    for one in folders:
        if names := shards.differing_options(first, formats.read("config", one / CONFIG)):
            both = f"{folders[0]} and {one} are shards of different sweeps"
            raise UserError(f"{both} (they differ in {names}): give the folder of one of them")
        pieces.append(Piece(one, load(one, find)[2]))
        for seed in pieces[-1].grid.seeds:
            if (other := of_seed.setdefault(seed, one)) != one:
                raise UserError(f"{other} and {one} both hold seed {seed}: delete the one that is a copy")
    return task, config, Grid(grid.guidance, tuple(of_seed), grid.labels), tuple(pieces)


def lanes_of(task: Task, config: RunConfig, pieces: tuple[Piece, ...], kind: str, sweep: bool) -> list[Block]:
    """Return the lanes of one kind of guidance, grouped by step, the furthest step first.

    In place of a policy they have what it is made of, "params" and "guidance" (leading axis: lanes). A failed lane is
    restored at its last finite state. Missing or unfinished shards are named on the console, one line each. `sweep`:
    whether these are a sweep's shards, some of which may not have begun.
    """
    env = shape_of(task, config.task)
    guidance = config.guide_in(env, kind)

    def lane(key: PRNGKeyArray) -> dict[str, Any]:
        return {"params": config.agent_in(env).init(key)[0], "guidance": guidance.init(key)}

    like = jax.eval_shape(lane, jax.random.key(0))
    groups: dict[int, list[tuple[np.ndarray, np.ndarray, Any]]] = {}
    notes = shards.missing([piece.folder / CONFIG for piece in pieces]) if sweep else []
    for folder, grid in pieces:
        if not (folder / kind / "checkpoints").is_dir():
            notes.append(f"{folder}: no checkpoint of {kind} guidance, left out")
            continue
        key, (seeds, budgets) = run_key(formats.read("config", folder / CONFIG), kind), grid.lanes(guidance)
        with Checkpoints(folder / kind / "checkpoints", read_only=True, run=key) as store:
            clock, _, count, size = restore_clock(store)
            shapes = jax.tree.map(lambda leaf, size=size: jax.ShapeDtypeStruct((size, *leaf.shape), leaf.dtype), like)
            failed = jax.ShapeDtypeStruct((size,), bool)
            arrays = store.restore({"policy": [shapes] * count, "failed": [failed] * count})
        blocks = list(zip(arrays["policy"], arrays["failed"], strict=True))
        lanes = jax.tree.map(lambda leaf, seeds=seeds: leaf[: len(seeds)], _concatenate(blocks))
        groups.setdefault(step := int(clock.step), []).append((seeds, budgets, lanes))
        if step < config.schedule.total_steps:
            notes.append(f"{folder}: {kind} guidance at step {step:,} of {config.schedule.total_steps:,}")
    if not groups:
        raise UserError(f"there is no checkpoint of {kind} guidance: train first, or choose another --guidance")
    for line in notes:
        console.print(line)
    blocks = []
    for step in sorted(groups, reverse=True):
        seeds, budgets, lanes = zip(*groups[step], strict=True)
        seeds, budgets, (policy, failed) = np.concatenate(seeds), np.concatenate(budgets), _concatenate(lanes)
        blocks.append(Block(kind, seeds, budgets, np.zeros(len(seeds)), step, policy, np.asarray(failed)))
    return blocks


def _concatenate(trees: Any) -> Any:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *trees)
