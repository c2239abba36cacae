"""The lanes of one kind of guidance: their blocks, and what is done with all of them."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import PRNGKeyArray

from cuelearner_jax.arbiters.protocol import Arbiter
from cuelearner_jax.asking import label_slots
from cuelearner_jax.devices import BY_LANE, lane_mesh, place
from cuelearner_jax.environment import Environment
from cuelearner_jax.evaluate import Tell, ignore_progress, rollout_lanes
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.loop import Clock, Program, TrainState, make_program
from cuelearner_jax.policies import PolicyBlock, arbiter_of
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.types import Label, Teacher

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

T = TypeVar("T")


class LaneGroup:
    """The lanes of one kind of guidance: one compiled program, its lanes cut into equal blocks."""

    def __init__(self, config: RunConfig, env: Any, guidance: Guide, grid: Grid, mesh: Mesh | None = None) -> None:
        self.config, self.env, self.guidance = config, env, guidance
        self.seeds, self.budgets = grid.lanes(guidance)
        self.largest_budget = int(self.budgets.max())
        self.mesh = mesh or lane_mesh()  # by default all local devices
        self.lanes_per_block = config.sizes.lanes_per_block or self._fitting_lanes()
        self.program: Program = make_program(
            config, guidance, env, self.largest_budget, self.mesh, lanes=self.cut.shape[1] // self.mesh.size
        )

    @property
    def arbiter(self) -> Arbiter:
        """The arbiter of all lanes."""
        return arbiter_of(self.config)

    @property
    def rounds(self) -> int:
        """Label rounds of the largest budget."""
        return label_slots(self.largest_budget, self.config.sizes) // self.config.sizes.labels_per_round

    def asked(self, rounds: int) -> np.ndarray:
        """Labels (lanes,) asked for after so many rounds."""
        return np.minimum(self.budgets, rounds * self.config.sizes.labels_per_round)

    def examined(self, rounds: int, before: int) -> np.ndarray:
        """Whose guide (lanes,) is looked at after so many rounds, those since `before` having changed it.

        At every multiple of `guide_eval_every` labels of its own, and at its last.
        """
        earlier, now, every = self.asked(before), self.asked(rounds), self.config.schedule.guide_eval_every
        due = now == self.budgets
        return (now > earlier) & (due | (now % every == 0) if every else due)

    def looks(self, rounds: int, given: bool) -> list[tuple[int, int, int]]:
        """(seed, budget, labels asked for) of each evaluation of a guide alone up to so many rounds.

        `given`: were labels taken from a file at once, instead of asked for?
        """
        made = [(0, rounds)] if given else [(number - 1, number) for number in range(1, rounds + 1)]
        found = []
        for before, after in made:
            due = self.examined(after, before)
            columns = (self.seeds, self.budgets, self.asked(after))
            found += zip(*(column[due].tolist() for column in columns), strict=True)
        return found

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
        """Lanes of a block: on accelerators all; on one CPU device an equal share for each core."""
        if jax.default_backend() != "cpu" or self.mesh.size > 1:
            return len(self.seeds)
        return -(-len(self.seeds) // CORES)

    @property
    def at_once(self) -> int:
        """Lanes that each device works on at the same time: of a CPU's block one."""
        if jax.default_backend() == "cpu":
            return min(CORES, len(self.cut)) if self.mesh.size == 1 else 1
        return self.cut.shape[1] // self.mesh.size

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

    def shapes_of(self, cut: np.ndarray) -> list[TrainState]:
        """Shapes of the blocks of a cut (see `cut`), without making them."""
        root, program = jax.random.key(0), self.program
        if len(cut[0]) % self.mesh.size:  # shapes alone: one device's program has the same
            program = make_program(self.config, self.guidance, self.env, self.largest_budget)
        return [
            jax.eval_shape(program.init, self.env, jnp.asarray(self.seeds[rows]), jnp.asarray(self.budgets[rows]), root)
            for rows in cut
        ]

    def train(
        self, clock: Clock, blocks: list[TrainState], iterations: int
    ) -> tuple[Clock, list[TrainState], list[dict[str, jax.Array]]]:
        """So many iterations of all lanes, done when this returns: (clock, blocks, each block's means (lanes,))."""
        settings = self.config.settings
        done = self.each(lambda block: self.program.train(self.env, settings, clock, block, iterations), blocks)
        after = jax.block_until_ready(done[0][0])
        return after, [block for _, block, _ in done], [measured for _, _, measured in done]

    def label_round(self, teacher: Teacher, clock: Clock, blocks: list[TrainState]) -> tuple[Clock, list[TrainState]]:
        """One round of questions to a simulated teacher, and the fit that follows it."""
        scalars = self.config.scalars
        done = self.each(lambda block: self.program.label_round(self.env, teacher, scalars, clock, block), blocks)
        return jax.block_until_ready(done[0][0]), [block for _, block in done]

    def take_labels(self, labels: list[Label], blocks: list[TrainState]) -> list[TrainState]:
        """Labels (lanes, slots, ...) of each block that were given elsewhere, and the fit to them."""
        return self.each(
            lambda rows, block: self.program.take_labels(self.env, self.config.scalars, rows, block), labels, blocks
        )

    def evaluate(
        self,
        policy_of: Callable[[TrainState], PolicyBlock],
        env: Environment,
        key: PRNGKeyArray,
        num_envs: int,
        steps: int,
        blocks: list[TrainState],
        tell: Tell = ignore_progress,
    ) -> dict[str, np.ndarray]:
        """Metrics (lanes,) of a policy of each block on the same episodes.

        One device tells between stretches how far each block is; several devices evaluate in one stretch.
        """
        mesh = self.mesh if self.mesh.size > 1 else None

        def measured(block: TrainState) -> dict[str, Any]:
            return rollout_lanes(env, policy_of(block), key, num_envs, steps, tell, mesh).means

        return self.columns(self.each(measured, blocks))

    def columns(self, blocks: list[Any]) -> dict[str, np.ndarray]:
        """Columns of one row a lane from per-block dictionaries of (lanes,) arrays."""
        return {
            name: np.concatenate([np.asarray(block[name]) for block in blocks])[: len(self.seeds)] for name in blocks[0]
        }
