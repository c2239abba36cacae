"""A run as it lies on the disk, whole or in the pieces of a sweep, and the lanes of its newest checkpoints."""

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
from cuelearner_jax.policies import acting_state, arbiter_of
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import shards
from cuelearner_jax.runs.grid import Grid, defaults, load
from cuelearner_jax.runs.lane_checkpoints import restore_policies
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.folders import CONFIG
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.terminal import console


class Piece(NamedTuple):
    """A folder with lanes of a run: all of them, or those of some seeds."""

    folder: Path
    grid: Grid


@dataclass(frozen=True)
class RunLanes:
    """The lanes of one kind of guidance that have come to the same step, as their newest checkpoints have them."""

    guidance: Guide
    seeds: np.ndarray  # (lanes,)
    budgets: np.ndarray  # (lanes,)
    policies: Any  # what they act with, see `policies.acting_state`, leading axis: lanes
    step: int


def open_run(folder: Path, find: Callable[[str], Task]) -> tuple[Task, RunConfig, Grid, tuple[Piece, ...]]:
    """The run in a folder, or the sweep whose pieces lie below it (`--shard`, `--cluster`); the grid is of all pieces.

    `find`: as `grid.load` has it. Raises UserError for no run, a task that is not known, or pieces of different sweeps.
    """
    files = [] if (folder / CONFIG).exists() else sorted(folder.glob(f"shard-*-of-*/{CONFIG}"))
    if not files:
        task, config, grid = load(folder, find)
        return task, config, grid, (Piece(folder, grid),)
    described = [formats.read("config", file) for file in files]
    loaded = [load(file.parent, find) for file in files]
    task, config, first = loaded[0]
    for file, other in zip(files, described, strict=True):
        if found := shards.apart(described[0], other, defaults(task)):
            raise UserError(
                f"{files[0].parent} and {file.parent} are pieces of different sweeps (another {found}): give the "
                "folder of one of them"
            )
    pieces = tuple(Piece(file.parent, grid) for file, (_, _, grid) in zip(files, loaded, strict=True))
    seeds = tuple(seed for piece in pieces for seed in piece.grid.seeds)
    return task, config, Grid(first.guidance, seeds, first.labels), pieces


def lanes_of(task: Task, config: RunConfig, pieces: tuple[Piece, ...], kind: str, sweep: bool) -> list[RunLanes]:
    """The lanes of one kind of guidance, those at the same step together, the farthest first.

    What is missing or not finished is said on the console, a line for each piece. `sweep`: are these the pieces of a
    sweep, some of which may not have begun? Raises UserError if no piece has a checkpoint, or one is damaged.
    """
    env = shape_of(task, config.task)
    guidance, arbiter = config.guide_in(env, kind), arbiter_of(config)

    def lane(key: PRNGKeyArray) -> dict[str, Any]:
        state = arbiter.init(config.sizes.num_envs)
        return acting_state(arbiter, config.agent_in(env).init(key)[0], guidance.init(key), state)

    like = jax.eval_shape(lane, jax.random.key(0))
    found: dict[int, list[RunLanes]] = {}
    told = shards.missing([piece.folder / CONFIG for piece in pieces]) if sweep else []
    for folder, grid in pieces:
        if sweep and not (folder / kind / "checkpoints").is_dir():
            told.append(f"{folder}: no checkpoint of {kind} guidance, left out")
            continue
        seeds, budgets = grid.lanes(guidance)
        policies, step = restore_policies(folder / kind, like, len(seeds))
        found.setdefault(step, []).append(RunLanes(guidance, seeds, budgets, policies, step))
        if step < config.schedule.total_steps:
            told.append(f"{folder}: {kind} guidance at step {step:,} of {config.schedule.total_steps:,}")
    for line in told:
        console.print(line)
    if not found:
        raise UserError(f"no piece has a checkpoint of {kind} guidance: train first, or choose another --guidance")
    return [_joined(found[step]) for step in sorted(found, reverse=True)]


def _joined(parts: list[RunLanes]) -> RunLanes:
    """Lanes of several pieces at one step."""
    if len(parts) == 1:
        return parts[0]
    seeds, budgets = (np.concatenate([getattr(part, name) for part in parts]) for name in ("seeds", "budgets"))
    policies = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *(part.policies for part in parts))
    return RunLanes(parts[0].guidance, seeds, budgets, policies, parts[0].step)
