"""Shared parts of benchmarks: rounds of labels in `speed.Timed`, and rows with the share of the matmul rate."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from _flops import step_operations

from cuelearner_jax.environment import spaces_of
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import speed
from cuelearner_jax.task import Task
from cuelearner_jax.types import Teacher


class Labelled(speed.Timed):
    """Lanes that ask, ready to be timed."""

    def label_round(self, teacher: Teacher) -> float:
        """Seconds of one round of questions and the fit that follows it. The first call compiles."""
        seconds, done = speed.timed(lambda: self.group.label_round(teacher, self.clock, self.blocks))
        self.clock, self.blocks = done
        return seconds

    def fit(self) -> float:
        """Seconds of one fit to the labels there are. The first call compiles."""
        # The blocks are given up to the program, so their labels go into it as copies.
        labels = [jax.block_until_ready(jax.tree.map(jnp.copy, block.guide.labels)) for block in self.blocks]
        seconds, self.blocks = speed.timed(lambda: self.group.take_labels(labels, self.blocks))
        return seconds


def matmul_rate(dtype: str = "float32", repeats: int = 5) -> float:
    """Large matrix products on one device [operations/s], best of `repeats`; a CPU is one device with all its cores.

    Float32 is computed as JAX does by default, as in training.
    """
    size, queued = (2048, 1) if jax.default_backend() == "cpu" else (8192, 10)
    a, b = (jax.random.normal(jax.random.key(k), (size, size), dtype) for k in (0, 1))
    product = jax.jit(jnp.matmul)
    product(a, b).block_until_ready()
    best = min(speed.timed(lambda: [product(a, b) for _ in range(queued)])[0] for _ in range(repeats))
    return queued * 2 * size**3 / best


def measure(task: Task, config: RunConfig, seeds: int, seconds: float, mesh: Any = None) -> dict[str, Any]:
    """A row of `speed.measure` with what the networks reach of the machine's matmul rate in the same run."""
    row = speed.measure(config, lambda: task.environment(config.task), seeds, seconds, mesh)
    rate = matmul_rate(repeats=3) * (row["devices"] if jax.default_backend() != "cpu" else 1)
    spaces = spaces_of(task.environment(config.task))
    flops = row["steps_a_second"] * step_operations(config, spaces).total
    return {
        **row,
        "task": task.name,
        "gflops": flops / 1e9,
        "matmul_gflops": rate / 1e9,
        "share_of_matmul": flops / rate,
    }
