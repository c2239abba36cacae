"""Save and restore a lane group's checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.errors import UserError
from cuelearner_jax.loop import Clock, TrainState, start_clock
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.storage.checkpoint import Checkpoints


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


def _clock(saved: Checkpoints) -> tuple[dict[str, Any], int, int]:
    """Return the item "clock", the number of blocks and lanes per block."""
    like = {"clock": jax.eval_shape(start_clock), "wall_s": np.float32(0), "cut": np.zeros(2, np.int32)}
    clock = saved.restore({"clock": like})["clock"]
    return clock, *clock["cut"].tolist()


def restore_blocks(group: LaneGroup, saved: Checkpoints) -> tuple[list[TrainState], Clock, float]:
    """Restore the newest checkpoint: blocks in this group's cut, the clock, and the seconds of training.

    Raises UserError if there is no readable checkpoint.
    """
    clock, count, size = _clock(saved)
    cut = np.minimum(np.arange(count * size), len(group.seeds) - 1).reshape(count, size)
    shapes = items(group.shapes_of(cut), jax.eval_shape(start_clock), 0.0)
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
    with Checkpoints(folder / "checkpoints", read_only=True, run=run) as saved:
        clock, count, size = _clock(saved)
        block = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((size, *leaf.shape), leaf.dtype), like)
        found = saved.restore({"policy": [block] * count, "failed": [jax.ShapeDtypeStruct((size,), bool)] * count})
    blocks = [{**policy, "failed": failed} for policy, failed in zip(found["policy"], found["failed"], strict=True)]
    policies = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[:lanes], *blocks)
    return policies, int(clock["clock"].step)
