"""A group of lanes of one kind of guidance, cut into blocks, and the operations on all blocks."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import PRNGKeyArray

from cuelearner_jax.asking import label_slots
from cuelearner_jax.devices import BY_LANE, CORES, fixed_numerics, lane_mesh, place
from cuelearner_jax.environment import Environment
from cuelearner_jax.evaluate import group_means, rollout_lanes
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.loop import Clock, TrainState
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.program import Program, make_program
from cuelearner_jax.types import Label, Teacher


class LaneGroup:
    """The lanes of one kind of guidance: one compiled program, with the lanes cut into equal blocks."""

    def __init__(self, config: RunConfig, env: Any, guidance: Guide, grid: Grid, mesh: Mesh | None = None) -> None:
        self.config, self.env, self.guidance = config, env, guidance
        self.seeds, self.budgets = grid.lanes(guidance)
        self.largest_budget = int(self.budgets.max())
        self.mesh = mesh or lane_mesh()  # by default all local devices
        # By default all lanes at once; on one CPU an equal share for each core.
        takers = CORES if jax.default_backend() == "cpu" and self.mesh.size == 1 else 1
        self.lanes_per_block = config.sizes.lanes_per_block or -(-len(self.seeds) // takers)
        lanes = self.cut.shape[1] // self.mesh.size
        self.program: Program = make_program(config, guidance, env, self.largest_budget, self.mesh, lanes=lanes)

    @property
    def rounds(self) -> int:
        """Label rounds of the largest budget."""
        return label_slots(self.largest_budget, self.config.sizes) // self.config.sizes.labels_per_round

    def label_counts(self, rounds: int) -> np.ndarray:
        """Return the labels (lanes,) asked for after a number of rounds."""
        return np.minimum(self.budgets, rounds * self.config.sizes.labels_per_round)

    def due_guides(self, rounds: int, before: int) -> np.ndarray:
        """Return a mask (lanes,) of the guides to evaluate after `rounds` rounds, the last time being `before`.

        A guide is due at every multiple of `guide_eval_every` labels of its own, and at its last label.
        """
        old, now, every = self.label_counts(before), self.label_counts(rounds), self.config.schedule.guide_eval_every
        due = now == self.budgets
        return (now > old) & (due | (now % every == 0) if every else due)

    def blocks(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return (seeds, budgets) of each block; the last block is padded with repeats, whose results are dropped."""
        return [(self.seeds[rows], self.budgets[rows]) for rows in self.cut]

    @property
    def cut(self) -> np.ndarray:
        """Lane numbers of each block (blocks, lanes of a block); the block size divides among the devices."""
        count = -(-len(self.seeds) // self.lanes_per_block)
        size = -(-len(self.seeds) // count)
        size = -(-size // self.mesh.size) * self.mesh.size
        return np.minimum(np.arange(count * size), len(self.seeds) - 1).reshape(count, size)

    def recut(self, blocks: list[TrainState]) -> list[TrainState]:
        """Return blocks of any cut in this group's cut."""
        if [block.key.shape[0] for block in blocks] != [len(rows) for rows in self.cut]:
            whole = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *blocks)
            blocks = [jax.tree.map(lambda leaf, rows=rows: leaf[rows], whole) for rows in self.cut]
        return [place(self.mesh, block, BY_LANE) for block in blocks]

    def each(self, work: Callable[..., Any], *blocks: list[Any]) -> list[Any]:
        """Apply `work` to every block; a CPU works on as many blocks at once as it has cores."""
        if jax.default_backend() != "cpu" or len(blocks[0]) == 1:
            return [work(*entries) for entries in zip(*blocks, strict=True)]
        work = fixed_numerics()(work)  # JAX's settings are a thread's own
        with ThreadPoolExecutor(CORES) as pool:
            return list(pool.map(lambda *entries: jax.block_until_ready(work(*entries)), *blocks))

    def start(self) -> list[TrainState]:
        """Return fresh blocks."""
        root = jax.random.key(0)
        return [self.program.init(self.env, jnp.asarray(s), jnp.asarray(b), root) for s, b in self.blocks()]

    def shapes_of(self, cut: np.ndarray) -> list[TrainState]:
        """Return the shapes of the blocks of a cut (see `cut`), without computing them."""
        root, program = jax.random.key(0), self.program
        if len(cut[0]) % self.mesh.size:  # for shapes alone, one device's program gives the same
            program = make_program(self.config, self.guidance, self.env, self.largest_budget)
        return [
            jax.eval_shape(program.init, self.env, jnp.asarray(self.seeds[rows]), jnp.asarray(self.budgets[rows]), root)
            for rows in cut
        ]

    def train(
        self, clock: Clock, blocks: list[TrainState], iterations: int
    ) -> tuple[Clock, list[TrainState], list[dict[str, jax.Array]]]:
        """Train all lanes for some iterations; return (clock, blocks, each block's means (lanes,)) when done."""
        settings = self.config.settings
        results = self.each(lambda block: self.program.train(self.env, settings, clock, block, iterations), blocks)
        clocks, blocks, metrics = map(list, zip(*results, strict=True))
        return jax.block_until_ready(clocks[0]), blocks, metrics

    def label_round(self, teacher: Teacher, clock: Clock, blocks: list[TrainState]) -> tuple[Clock, list[TrainState]]:
        """Ask a simulated teacher one round of questions and fit the guides to all answers."""
        scalars = self.config.scalars
        results = self.each(lambda block: self.program.label_round(self.env, teacher, scalars, clock, block), blocks)
        return jax.block_until_ready(results[0][0]), [block for _, block in results]

    def take_labels(self, labels: list[Label], blocks: list[TrainState]) -> list[TrainState]:
        """Take labels (lanes, slots, ...) of each block from elsewhere and fit the guides to them."""
        take = lambda rows, block: self.program.take_labels(self.env, self.config.scalars, rows, block)  # noqa: E731
        return self.each(take, labels, blocks)

    def evaluate(
        self, policy_of: Any, env: Environment, key: PRNGKeyArray, num_envs: int, steps: int, blocks: list[TrainState]
    ) -> dict[str, np.ndarray]:
        """Return metrics (lanes,) of each block's policy (`policy_of`) on the same episodes, and `group_means`."""
        mesh = self.mesh if self.mesh.size > 1 else None

        def measure(block: TrainState) -> dict[str, Any]:
            means, each, _ = rollout_lanes(env, policy_of(block), key, num_envs, steps, mesh=mesh)
            return means | {f"{name}_each": group_means(np.asarray(values)) for name, values in each.items()}

        return self.columns(self.each(measure, blocks))

    def columns(self, blocks: list[Any]) -> dict[str, np.ndarray]:
        """Join per-block dictionaries of (lanes,) arrays into columns with one row per lane."""
        whole = {name: np.concatenate([np.asarray(block[name]) for block in blocks]) for name in blocks[0]}
        return {name: column[: len(self.seeds)] for name, column in whole.items()}
