"""Shared parts of benchmarks: what training costs on this machine, and rounds of labels.

Training is unguided, with the program of `cuelearner sweep`, learning from the first step on. Compilation and the first
stretch are apart; figures are medians over stretches of some iterations.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from cuelearner_jax.devices import SHARED, lane_mesh, place
from cuelearner_jax.environment import Environment
from cuelearner_jax.loop import start_clock
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.types import Teacher

FEWEST_STRETCHES = 3
STEPS_A_STRETCH = {"cpu": 128, "gpu": 1024, "tpu": 1024}  # per seed

T = TypeVar("T")


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Return the seconds until everything that `work` returns is computed, and the returned value."""
    began = time.perf_counter()
    done = jax.block_until_ready(work())
    return time.perf_counter() - began, done


class Timed:
    """Lanes of one kind of guidance, ready to be timed."""

    def __init__(self, config: RunConfig, env: Environment, kind: str, seeds: int, labels: int = 0) -> None:
        mesh = lane_mesh()
        env, grid = place(mesh, env, SHARED), Grid((kind,), tuple(range(seeds)), (labels,))
        self.group = LaneGroup(config, env, config.guide_in(env, kind), grid, mesh)
        self.clock, self.blocks = place(mesh, start_clock(), SHARED), self.group.start()

    def train(self, iterations: int) -> float:
        """Return the seconds for some iterations of all lanes. The first call with a number compiles."""
        seconds, done = timed(lambda: self.group.train(self.clock, self.blocks, iterations))
        self.clock, self.blocks, _ = done
        return seconds


class Labelled(Timed):
    """Lanes that ask, ready to be timed."""

    def label_round(self, teacher: Teacher) -> float:
        """Seconds of one round of questions and the fit that follows it. The first call compiles."""
        seconds, done = timed(lambda: self.group.label_round(teacher, self.clock, self.blocks))
        self.clock, self.blocks = done
        return seconds

    def fit(self) -> float:
        """Seconds of one fit to the labels there are. The first call compiles."""
        # The blocks are given up to the program, so their labels go into it as copies.
        labels = [jax.block_until_ready(jax.tree.map(jnp.copy, block.guide.labels)) for block in self.blocks]
        seconds, self.blocks = timed(lambda: self.group.take_labels(labels, self.blocks))
        return seconds


def learning(config: RunConfig) -> RunConfig:
    """Return the configuration with greedy actions and learning from the first step, without guidance."""
    schedule = dataclasses.replace(config.schedule, random_steps=0, learn_after=0, guidance_until=0)
    return dataclasses.replace(config, schedule=schedule)


def measure(env: Callable[[], Environment], config: RunConfig, seeds: int, seconds: float) -> dict[str, Any]:
    """Measure the training of `seeds` unguided lanes for `seconds` after compilation, over all devices.

    Returns:
        `steps_a_second` (environment steps of all seeds), `ms_a_step` (one step of every seed), `mb_a_seed` (at rest)
        and `peak_gb` (of the first device in this process so far; None where unknown). Further `first_step_s`
        (environment, compilation and first step, without imports), `seeds`, `devices`, `stretches` and `spread`
        (slowest less fastest stretch, over their median).
    """
    began = time.perf_counter()
    group = Timed(learning(config), env(), "none", seeds)
    iterations = max(1, STEPS_A_STRETCH[jax.default_backend()] // config.sizes.num_envs)
    group.train(iterations)
    first = time.perf_counter() - began
    at_rest = sum(leaf.nbytes for leaf in jax.tree.leaves(group.blocks)) / sum(len(block.key) for block in group.blocks)
    stretches = []
    while len(stretches) < FEWEST_STRETCHES or sum(stretches) < seconds:
        stretches.append(group.train(iterations))
    typical = statistics.median(stretches)
    step = typical / iterations / config.sizes.num_envs
    memory = jax.local_devices()[0].memory_stats() or {}
    return {
        "seeds": seeds,
        "devices": group.group.mesh.size,
        "steps_a_second": seeds / step,
        "ms_a_step": 1e3 * step,
        "mb_a_seed": at_rest / 1e6,
        "peak_gb": memory["peak_bytes_in_use"] / 1e9 if "peak_bytes_in_use" in memory else None,
        "first_step_s": first - (iterations - 1) / iterations * typical,
        "stretches": len(stretches),
        "spread": (max(stretches) - min(stretches)) / typical,
    }
