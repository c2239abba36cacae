"""Save and restore a lane group's checkpoint, and check its folder before resuming."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.compute as pc

from cuelearner_jax.errors import UserError
from cuelearner_jax.loop import Clock, TrainState, start_clock
from cuelearner_jax.runs.grid import run_key
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.storage import formats, label_files, results
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.checkpoint import Checkpoints, checkpoints

DUE = "due.json"  # columns of a stretch whose evaluation was interrupted, beside the checkpoint at its end


def items(blocks: list[TrainState], clock: Clock, wall: float) -> dict[str, Any]:
    """Return a run's state as checkpoint items; acting needs only the first, the last gives the cut of lanes."""
    return {
        "policy": [{"params": block.agent.params, "guidance": block.guide.model} for block in blocks],
        "rest": [
            block.replace(agent=block.agent.replace(params=None), guide=block.guide.replace(model=None), failed=None)
            for block in blocks
        ],
        "failed": [block.failed for block in blocks],
        "clock": {
            "clock": clock,
            "wall_s": np.float32(wall),
            "cut": np.array([len(blocks), blocks[0].key.shape[0]], np.int32),
        },
    }


def _clock(saved: Checkpoints, lanes: int) -> tuple[dict[str, Any], int, int]:
    """Return the item "clock", the number of blocks and lanes per block. Raises UserError for too few lanes."""
    like = {"clock": jax.eval_shape(start_clock), "wall_s": np.float32(0), "cut": np.zeros(2, np.int32)}
    clock = saved.restore({"clock": like})["clock"]
    count, size = (int(number) for number in clock["cut"])
    if size < 1 or count * size < lanes:
        raise UserError(
            f"the checkpoint holds {count * size} lanes, the run has {lanes}: start the run again with --overwrite"
        )
    return clock, count, size


def _shapes(group: LaneGroup, saved: Checkpoints) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the newest checkpoint's item "clock", and the shapes of all items in the blocks of its writing.

    Raises UserError if there is no readable checkpoint, or it holds fewer lanes.
    """
    clock, count, size = _clock(saved, len(group.seeds))
    cut = np.minimum(np.arange(count * size), len(group.seeds) - 1).reshape(count, size)
    return clock, items(group.shapes_of(cut), jax.eval_shape(start_clock), 0.0)


def restore_blocks(group: LaneGroup, saved: Checkpoints) -> tuple[list[TrainState], Clock, float]:
    """Restore the newest checkpoint: blocks in this group's cut, the clock, and the seconds of training.

    Raises UserError if there is no readable checkpoint or it holds other lanes.
    """
    clock, shapes = _shapes(group, saved)
    found = saved.restore({name: shapes[name] for name in ("policy", "rest", "failed")})
    blocks = [
        rest.replace(
            agent=rest.agent.replace(params=policy["params"]),
            guide=rest.guide.replace(model=policy["guidance"]),
            failed=failed,
        )
        for policy, rest, failed in zip(found["policy"], found["rest"], found["failed"], strict=True)
    ]
    return group.recut(blocks), clock["clock"], float(clock["wall_s"])


def write_due(folder: Path, step: int, columns: dict[str, np.ndarray]) -> None:
    """Save the columns (lanes,) of a stretch up to `step` whose evaluation was interrupted."""
    formats.write("due", folder / DUE, {"step": step, "columns": {name: c.tolist() for name, c in columns.items()}})


def read_due(folder: Path, step: int, lanes: int) -> dict[str, np.ndarray] | None:
    """Return the columns (lanes,) of a stretch up to `step` that waits for its evaluation; None: no such stretch.

    Raises UserError if the file cannot be read or is damaged.
    """
    path = folder / DUE
    if not path.exists():
        return None
    values = formats.read("due", path)
    columns = {name: np.array(column, np.float32).reshape(lanes) for name, column in values["columns"].items()}
    return columns if values["step"] == step else None


def check_standing(group: LaneGroup, folder: Path, described: dict[str, Any], given: bool = False) -> None:
    """Check that a group can resume from its folder: no rows are missing and nothing was changed.

    Rows must reach up to the newest checkpoint, or to the end of a finished run. Rows after the checkpoint are
    computed again. `described`: contents of config.json. `given`: whether the labels come from a file.

    Raises UserError if rows are missing, a file cannot be read, or the checkpoint is of another version of the program;
    nothing has been changed.
    """
    schedule, finished = group.config.schedule, (folder / results.PARQUET).exists()
    step, rounds = (schedule.total_steps, group.rounds) if finished else (0, 0)
    key = run_key(described, group.guidance.name)
    waits = False  # whether the newest stretch still needs its evaluation
    if not finished and (folder / "checkpoints").is_dir():
        with checkpoints(folder / "checkpoints", read_only=True, run=key) as saved:
            if saved.latest() is not None:
                item, shapes = _shapes(group, saved)
                saved.compare({name: shapes[name] for name in ("policy", "rest")})
                saved.restore({"failed": shapes["failed"]})
                step, rounds = int(item["clock"].step), int(item["clock"].round)
                waits = read_due(folder, step, len(group.seeds)) is not None
    if step:
        lanes = list(zip(group.seeds.tolist(), group.budgets.tolist(), strict=True))
        evaluated = range(0, step if waits else step + 1, schedule.eval_every)
        rows = [(*lane, at) for lane in lanes for at in evaluated]
        columns, among = ("seed", "labels", "step"), pc.field("step").isin(list(evaluated))
        results.check_complete(folder, results.SCHEMA, columns, rows, among, key)
    elif (folder / results.JSONL).exists():
        tables.read(folder / results.JSONL, results.SCHEMA)
    # runs finished by earlier versions have no such table
    if results.GUIDES.found_in(folder) or (rounds and not finished):
        columns, among = ("seed", "labels", "asked"), pc.field("round") <= rounds
        results.check_complete(folder, results.GUIDES, columns, group.looks(rounds, given), among, key)
    labels = folder / label_files.PARQUET
    is_torn = not finished and not label_files.readable(labels)  # by a kill: it is written anew
    if group.guidance.asks and not is_torn and label_files.read(labels).run not in (None, key):
        raise UserError(f"{labels} belongs to another run: put its own back")


def restore_policies(folder: Path, like: Any, lanes: int, run: str) -> tuple[dict[str, Any], int]:
    """Restore what the lanes of a run's folder act with, and whether each has failed.

    A failed lane is restored at its last finite state.

    Args:
        folder: the folder of one kind of guidance.
        like: shapes of what one lane acts with: {"params": the agent's, "guidance": the guide's model}.
        lanes: number of lanes.
        run: the key of the run and kind (`grid.run_key`).

    Returns:
        What the lanes act with, and "failed", with lanes as leading axis; and their training step.

    Raises:
        UserError: there is no readable checkpoint.
    """
    if not (folder / "checkpoints").is_dir():
        raise UserError(f"no checkpoint in {folder}: train first, or give a run folder that has one")
    with checkpoints(folder / "checkpoints", read_only=True, run=run) as saved:
        clock, count, size = _clock(saved, lanes)
        block = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((size, *leaf.shape), leaf.dtype), like)
        found = saved.restore({"policy": [block] * count, "failed": [jax.ShapeDtypeStruct((size,), bool)] * count})
    blocks = [{**policy, "failed": failed} for policy, failed in zip(found["policy"], found["failed"], strict=True)]
    policies = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:lanes], *blocks)
    return policies, int(clock["clock"].step)
