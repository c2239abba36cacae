"""Measure what training costs on this machine: throughput, memory per seed, time to the first step.

Every measurement trains unguided lanes with the program of `cuelearner sweep`, learning from the first step on.
Compilation and the first stretch are reported separately; figures are medians over stretches of some iterations.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax.sharding import Mesh

from cuelearner_jax.devices import SHARED, lane_mesh, place
from cuelearner_jax.environment import Environment
from cuelearner_jax.loop import start_clock
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.lanes import LaneGroup

FEWEST_STRETCHES = 3
STEPS_A_STRETCH = {"cpu": 128, "gpu": 1024, "tpu": 1024}  # per seed

T = TypeVar("T")


class Timed:
    """Lanes of one kind of guidance, ready to be timed."""

    def __init__(
        self, config: RunConfig, env: Environment, kind: str, seeds: int, labels: int = 0, mesh: Mesh | None = None
    ) -> None:
        mesh = mesh or lane_mesh()
        self.group = lanes(config, place(mesh, env, SHARED), kind, seeds, labels, mesh=mesh)
        self.clock, self.blocks = place(mesh, start_clock(), SHARED), self.group.start()

    def train(self, iterations: int) -> float:
        """Return the seconds for some iterations of all lanes. The first call with a number compiles."""
        seconds, done = timed(lambda: self.group.train(self.clock, self.blocks, iterations))
        self.clock, self.blocks, _ = done
        return seconds


def lanes(config: RunConfig, env: Environment, kind: str, seeds: int, labels: int = 0, *, mesh: Mesh) -> LaneGroup:
    """Return the lane group of a measurement; `env` may be its shapes."""
    made = config.guide_in(env, kind)
    return LaneGroup(config, env, made, Grid((kind,), tuple(range(seeds)), (labels,)), mesh)


def learning(config: RunConfig, *, guided: bool = False) -> RunConfig:
    """Return the configuration with greedy actions and learning from the first step; always guided, or never."""
    until = 2**30 if guided else 0
    schedule = dataclasses.replace(config.schedule, random_steps=0, learn_after=0, guidance_until=until)
    return dataclasses.replace(config, schedule=schedule)


def measure(
    config: RunConfig,
    env: Callable[[], Environment],
    seeds: int,
    seconds: float,
    mesh: Mesh | None = None,
    watch: Callable[[str], None] = lambda note: None,
) -> dict[str, Any]:
    """Measure the training of `seeds` unguided lanes.

    Args:
        config: the configuration to train, with the schedule of `learning`.
        env: makes the environment, which counts towards the time to the first step.
        seeds: number of seeds that train at once, over all devices.
        seconds: time of the measurement after compilation (at least three stretches) [s].
        mesh: devices that share the seeds (default: all).
        watch: called with a note before each stretch.

    Returns:
        `steps_a_second` (environment steps of all seeds), `ms_a_step` (one step of every seed), `mb_a_seed` (at rest)
        and `peak_gb` (of the first device in this process so far; None where unknown). Further `first_step_s`
        (environment, compilation and first step, without imports), `seeds`, `devices`, `stretches` and `spread`
        (slowest less fastest stretch, over their median).
    """
    watch("compiling")
    began, mesh = time.perf_counter(), mesh or lane_mesh()
    group = Timed(learning(config), env(), "none", seeds, mesh=mesh)
    iterations = max(1, STEPS_A_STRETCH[jax.default_backend()] // config.sizes.num_envs)
    group.train(iterations)
    first = time.perf_counter() - began
    at_rest = sum(state_bytes(block) for block in group.blocks) / sum(block.key.shape[0] for block in group.blocks)
    stretches = []
    while len(stretches) < FEWEST_STRETCHES or sum(stretches) < seconds:
        watch("training")
        stretches.append(group.train(iterations))
    typical = statistics.median(stretches)
    step = typical / iterations / config.sizes.num_envs
    memory = jax.local_devices()[0].memory_stats() or {}
    return {
        "seeds": seeds,
        "devices": mesh.size,
        "steps_a_second": seeds / step,
        "ms_a_step": 1e3 * step,
        "mb_a_seed": at_rest / 1e6,
        "peak_gb": memory["peak_bytes_in_use"] / 1e9 if "peak_bytes_in_use" in memory else None,
        "first_step_s": first - (iterations - 1) / iterations * typical,
        "stretches": len(stretches),
        "spread": (max(stretches) - min(stretches)) / typical,
    }


def state_bytes(tree: Any) -> int:
    """Return the memory of a tree of arrays or shapes [bytes]."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Return the seconds until everything that `work` returns is computed, and the returned value."""
    began = time.perf_counter()
    done = jax.block_until_ready(work())
    return time.perf_counter() - began, done
