"""The lanes of one kind of guidance: their blocks, the memory they need, and what of them is kept in a checkpoint."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from cuelearner_jax.agent.choice import looked_at
from cuelearner_jax.config import RunConfig
from cuelearner_jax.devices import BY_LANE, lane_mesh, place, portions
from cuelearner_jax.errors import UserError
from cuelearner_jax.records.checkpoint import Checkpoints, checkpoints
from cuelearner_jax.runs.free_memory import free_bytes
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.train import Program, label_slots, make_program, start_clock
from cuelearner_jax.types import Clock, Guidance, TrainState

CACHE_BYTES = 4_000_000  # of the action-value weights of a CPU's block: beyond, they leave the cache between two steps
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

T = TypeVar("T")


class Group:
    """The lanes of one kind of guidance: one compiled program, its lanes cut into equal blocks."""

    def __init__(self, config: RunConfig, env: Any, guidance: Guidance, grid: Grid, mesh: Mesh | None = None) -> None:
        self.config, self.env, self.guidance = config, env, guidance
        self.seeds, self.budgets = grid.lanes(guidance)
        self.largest_budget = int(self.budgets.max())
        self.mesh = mesh or lane_mesh()  # by default all local devices
        self.lanes_per_block = config.sizes.lanes_per_block or self._fitting_lanes()
        self.program: Program = make_program(
            config, guidance, env, self.largest_budget, self.mesh, lanes=self.cut.shape[1] // self.mesh.size
        )

    @property
    def rounds(self) -> int:
        """Label rounds of the largest lane."""
        return label_slots(self.largest_budget, self.config.sizes) // self.config.sizes.labels_per_round

    def blocks(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """(seeds, budgets) of each block; the last is filled up with repeats, whose results are dropped."""
        return [(self.seeds[rows], self.budgets[rows]) for rows in self.cut]

    @property
    def cut(self) -> np.ndarray:
        """Numbers of the lanes of each block (blocks, lanes of a block), which divide among the devices."""
        count = -(-len(self.seeds) // self.lanes_per_block)
        size = -(-len(self.seeds) // count)
        size = -(-size // self.mesh.size) * self.mesh.size
        return np.minimum(np.arange(count * size), len(self.seeds) - 1).reshape(count, size)

    def recut(self, blocks: list[TrainState]) -> list[TrainState]:
        """Blocks of whatever cut in this group's."""
        if [block.key.shape[0] for block in blocks] != [len(rows) for rows in self.cut]:
            joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *blocks)
            blocks = [jax.tree.map(lambda leaf, rows=rows: leaf[rows], joined) for rows in self.cut]
        return [place(self.mesh, block, BY_LANE) for block in blocks]

    def _fitting_lanes(self) -> int:
        """Lanes of a block: on accelerators all; on one CPU device what fits its cache, and a block for each core."""
        if jax.default_backend() != "cpu" or self.mesh.size > 1:
            return len(self.seeds)
        widths = [self.env.obs_size + 2, *self.config.sizes.q_layers, 1]
        weights = 4 * sum(a * b for a, b in pairwise(widths))
        return max(1, min(CACHE_BYTES // weights, -(-len(self.seeds) // CORES)))

    def each(self, work: Callable[..., T], *blocks: list[Any]) -> list[T]:
        """`work` of every block. A CPU takes as many at once as it has cores, which then seldom wait for each other."""
        if jax.default_backend() != "cpu" or len(blocks[0]) == 1:
            return [work(*entries) for entries in zip(*blocks, strict=True)]
        with ThreadPoolExecutor(CORES) as pool:
            return list(pool.map(lambda *entries: jax.block_until_ready(work(*entries)), *blocks))

    def start(self) -> list[TrainState]:
        """Fresh blocks."""
        root = jax.random.key(0)
        return [self.program.init(self.env, jnp.asarray(s), jnp.asarray(b), root) for s, b in self.blocks()]

    def shapes(self) -> list[TrainState]:
        """Shapes of the blocks, without making them."""
        return self.shapes_of(self.cut)

    def shapes_of(self, cut: np.ndarray) -> list[TrainState]:
        """The same, of another cut."""
        root, program = jax.random.key(0), self.program
        if len(cut[0]) % self.mesh.size:  # shapes alone: one device's program has the same
            program = make_program(self.config, self.guidance, self.env, self.largest_budget)
        return [
            jax.eval_shape(program.init, self.env, jnp.asarray(self.seeds[rows]), jnp.asarray(self.budgets[rows]), root)
            for rows in cut
        ]

    def lanes(self, blocks: list[Any]) -> dict[str, np.ndarray]:
        """Columns of one row a lane from per-block dictionaries of (lanes,) arrays."""
        return {
            name: np.concatenate([np.asarray(block[name]) for block in blocks])[: len(self.seeds)] for name in blocks[0]
        }


def state_bytes(tree: Any) -> int:
    """Memory of a tree of arrays or shapes [bytes]."""
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def memory_report(group: Group) -> str:
    """One line on the memory that the lanes need on each device. Raises UserError if it is more than there is."""
    shapes = group.shapes()
    sizes, lanes, devices = group.config.sizes, len(group.seeds), group.mesh.size
    padded = sum(len(seeds) for seeds, _ in group.blocks())
    kept = sum(state_bytes(block) for block in shapes) // devices
    # Activations of the widest pass: the argmax while acting, that inside targets, or a batch with its gradient.
    widest = max(*sizes.q_layers, *sizes.feedback_layers)
    looked = looked_at(sizes)
    rows = max(
        min(sizes.num_envs * looked, max(portions().actions, looked)), 3 * sizes.batch_size * len(sizes.q_layers)
    )
    if group.config.bootstraps:
        rows = max(rows, sizes.batch_size * sizes.target_directions * (2 if sizes.n_step > 1 else 1))
    working = 4 * 4 * widest * rows * (padded // len(shapes) // devices)
    each = f" on each of {devices} devices" if devices > 1 else ""
    available = free_bytes()
    limit = f", {available / 1e9:.1f} GB are free" if available else ""
    if available and kept + working > available:
        fitting = max(int((available - working) // (kept / padded)), 0)
        raise UserError(
            f"{lanes} lanes need {(kept + working) / 1e9:.1f} GB{each}, {available / 1e9:.1f} GB are free: "
            f"train at most {fitting} at once, or lower --sizes.replay-capacity"
        )
    return (
        f"{group.guidance.name}: {lanes} lanes, {kept * devices / padded / 1e6:.1f} MB a seed at rest, "
        f"{(kept + working) / 1e9:.2f} GB in all while training{each}{limit}"
    )


def items(blocks: list[TrainState], clock: Clock, wall: float) -> dict[str, Any]:
    """A run's state as the items of a checkpoint: acting needs the first alone; the last says how lanes are cut."""
    return {
        "policy": [{"params": block.params, "guidance": block.guidance} for block in blocks],
        "rest": [block.replace(params=None, guidance=None) for block in blocks],
        "clock": {
            "clock": clock,
            "wall_s": np.float32(wall),
            "cut": np.array([len(blocks), blocks[0].key.shape[0]], np.int32),
        },
    }


def restore(group: Group, saved: Checkpoints, *names: str) -> dict[str, Any]:
    """Items of the newest checkpoint by name, and "clock". Blocks are cut as they were when it was written.

    Raises UserError if there is no readable checkpoint or it holds other lanes.
    """
    shapes = items(group.shapes(), jax.eval_shape(start_clock), 0.0)
    clock = saved.restore({"clock": shapes["clock"]})["clock"]
    count, size = (int(number) for number in clock["cut"])
    if size < 1 or count * size < len(group.seeds):
        raise UserError(f"the checkpoint holds {count * size} lanes, the run has {len(group.seeds)}: start it anew")
    cut = np.minimum(np.arange(count * size), len(group.seeds) - 1).reshape(count, size)
    shapes = items(group.shapes_of(cut), jax.eval_shape(start_clock), 0.0)
    return {**saved.restore({name: shapes[name] for name in names}), "clock": clock}


def restore_policies(group: Group, folder: Path) -> tuple[dict[str, Any], int]:
    """What the lanes of a run's folder act with: ({"params": ..., "guidance": ...}, leading axis: lanes; their step).

    Raises UserError if there is no readable checkpoint.
    """
    if not (folder / "checkpoints").is_dir():
        raise UserError(f"no checkpoint in {folder}: train first, or give a run folder that has one")
    with checkpoints(folder / "checkpoints", read_only=True) as saved:
        found = restore(group, saved, "policy")
    policies = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[: len(group.seeds)], *found["policy"])
    return policies, int(found["clock"]["clock"].step)
