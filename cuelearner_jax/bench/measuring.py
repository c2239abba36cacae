"""What training costs on this machine: throughput, share of its matmul rate, memory a seed, time to the first step.

Every measurement trains unguided lanes by the program that `cuelearner sweep` runs, learning from the first step on.
Compiling and the first stretch stay apart; figures are medians over stretches of some iterations. `Timed`, `learning`
and `matmul_rate` serve the files in `benchmarks/` too.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from cuelearner_jax import config as configuration
from cuelearner_jax.bench import known_machines as machines
from cuelearner_jax.bench.flops import step_operations
from cuelearner_jax.config import RunConfig
from cuelearner_jax.devices import SHARED, lane_mesh, place
from cuelearner_jax.environment import Environment, Spaces, spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.runs.grid import LARGEST_SEED, Grid
from cuelearner_jax.runs.lanes import CORES, LaneGroup
from cuelearner_jax.runs.memory_report import memory_report, state_bytes
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.terminal import Interrupted, console, interruptible, progress_bars
from cuelearner_jax.types import Teacher

FEWEST_STRETCHES = 3
LONGEST_STRETCH = 1024  # steps of a seed
STRETCH_S = 0.25  # of a stretch at the rate below, which decides its length only and is the same on every machine
NOMINAL_RATE = {"cpu": 1e11, "accelerator": 1e14}  # [operations/s]

T = TypeVar("T")


@dataclass(frozen=True)
class Measuring:
    """How to measure."""

    seeds: tuple[int, ...] = (8,)
    """Numbers of seeds that train at once, over all devices."""
    seconds: float = 2.0
    """Time of each measurement once it is compiled (three stretches at least)."""
    devices: int = 0
    """Devices that share the seeds (0: all)."""
    out: Path | None = None
    """Also write the figures to this JSON file, an entry of the table of known machines."""
    name: str = ""
    """What the machine is called in that table (default: its hardware)."""
    note: str = ""
    """What a reader of the figures must know, for instance that the machine is shared."""


@dataclass(frozen=True)
class Work:
    """A configuration to measure."""

    task: Task
    preset: str
    config: RunConfig

    @property
    def changed(self) -> dict[str, Any]:
        """The options that differ from the preset's, by their dotted names."""
        usual = dict(_options(configuration.to_json(self.task.presets[self.preset].config)))
        asked = dict(_options(configuration.to_json(self.config)))
        return {name: value for name, value in asked.items() if usual[name] != value}


class Timed:
    """Lanes of one kind of guidance, ready to be timed."""

    def __init__(
        self, config: RunConfig, env: Environment, kind: str, seeds: int, labels: int = 0, mesh: Mesh | None = None
    ) -> None:
        mesh = mesh or lane_mesh()
        made = guidances.make(kind, config.sizes, env)
        env = place(mesh, env, SHARED)
        self.group = LaneGroup(config, env, made, Grid((kind,), tuple(range(seeds)), (labels,)), mesh)
        self.clock, self.blocks = place(mesh, start_clock(), SHARED), self.group.start()

    def train(self, iterations: int) -> float:
        """Seconds of so many iterations of all lanes. The first call with a number compiles."""
        seconds, done = _timed(lambda: self.group.train(self.clock, self.blocks, iterations))
        self.clock, self.blocks, _ = done
        return seconds

    def label_round(self, teacher: Teacher) -> float:
        """Seconds of one round of questions and the fit that follows it. The first call compiles."""
        seconds, done = _timed(lambda: self.group.label_round(teacher, self.clock, self.blocks))
        self.clock, self.blocks = done
        return seconds

    def fit(self) -> float:
        """Seconds of one fit to the labels there are. The first call compiles."""
        # The blocks are given up to the program, so their labels go into it as copies.
        labels = [jax.block_until_ready(jax.tree.map(jnp.copy, block.guide.labels)) for block in self.blocks]
        seconds, self.blocks = _timed(lambda: self.group.take_labels(labels, self.blocks))
        return seconds


def learning(config: RunConfig, *, guided: bool = False) -> RunConfig:
    """The configuration with greedy actions and gradient steps from the first step on; guided throughout, or never."""
    until = 2**30 if guided else 0
    schedule = dataclasses.replace(config.schedule, random_steps=0, learn_after=0, guidance_until=until)
    return dataclasses.replace(config, schedule=schedule)


def matmul_rate(dtype: str = "float32", repeats: int = 5) -> float:
    """Large matrix products on one device [operations/s], best of `repeats`; a CPU is one device with all its cores.

    Float32 is computed as JAX does by default, as in training.
    """
    size, queued = (2048, 1) if jax.default_backend() == "cpu" else (8192, 10)
    a, b = (jax.random.normal(jax.random.key(k), (size, size), dtype) for k in (0, 1))
    product = jax.jit(jnp.matmul)
    product(a, b).block_until_ready()
    best = min(_timed(lambda: [product(a, b) for _ in range(queued)])[0] for _ in range(repeats))
    return queued * 2 * size**3 / best


def iterations_of(config: RunConfig, spaces: Spaces, seeds: int) -> int:
    """Iterations of one stretch: a power of two that depends on the work alone, so that programs are found compiled."""
    sizes = config.sizes
    rate = NOMINAL_RATE["cpu" if jax.default_backend() == "cpu" else "accelerator"]
    one = seeds * sizes.num_envs * step_operations(sizes, spaces, config.bootstraps).total / rate
    most = min(STRETCH_S / one, LONGEST_STRETCH / sizes.num_envs)
    return 2 ** max(0, math.floor(math.log2(most)))


def measure(
    work: Work, seeds: int, mesh: Mesh, seconds: float, told: Callable[[str], None] = lambda note: None
) -> dict[str, Any]:
    """One row of figures; `machines.ROW` says what each is. `told` hears of each stretch before it begins."""
    config = learning(work.config)
    sizes = config.sizes
    told("compiling")
    began = time.perf_counter()
    env = work.task.environment(config.task)
    timed = Timed(config, env, "none", seeds, mesh=mesh)
    iterations = iterations_of(config, spaces_of(env), seeds)
    timed.train(iterations)
    first = time.perf_counter() - began
    at_rest = sum(state_bytes(block) for block in timed.blocks)
    lanes = sum(block.key.shape[0] for block in timed.blocks)
    told("training")
    rates, stretches = _rates(), []
    while len(stretches) < FEWEST_STRETCHES or sum(stretches) < seconds:
        told("training")
        stretches.append(timed.train(iterations))
    rates = {name: max(rate, rates[name]) for name, rate in _rates().items()}
    iteration = statistics.median(stretches) / iterations
    steps = seeds * sizes.num_envs / iteration
    flops = steps * step_operations(sizes, spaces_of(env), config.bootstraps).total
    working = mesh.size if jax.default_backend() != "cpu" else 1  # CPU devices share the cores
    memory = jax.local_devices()[0].memory_stats() or {}
    return {
        "task": work.task.name,
        "preset": work.preset,
        "changed": work.changed,
        "seeds": seeds,
        "devices": mesh.size,
        "steps_a_second": steps,
        "updates_a_second": steps * sizes.updates_per_step,
        "ms_an_iteration": 1e3 * iteration,
        "ms_a_step": 1e3 * iteration / sizes.num_envs,
        "mflop_a_step": flops / steps / 1e6,
        "gflops": flops / 1e9,
        "matmul_gflops": {name: rate * working / 1e9 for name, rate in rates.items()},
        "share_of_matmul": {name: flops / (rate * working) for name, rate in rates.items()},
        "mb_a_seed": at_rest / lanes / 1e6,
        "peak_gb": memory["peak_bytes_in_use"] / 1e9 if "peak_bytes_in_use" in memory else None,
        "first_step_s": first - (iterations - 1) * iteration,
        "stretches": len(stretches),
        "spread": (max(stretches) - min(stretches)) / statistics.median(stretches),
    }


def run(works: Sequence[Work], asked: Measuring, command: str) -> dict[str, Any]:
    """Measures every configuration at every number of seeds; returns an entry of the table of known machines.

    Raises:
        UserError: bad options or too little memory; nothing has been measured then.
        Interrupted: Ctrl-C or SIGTERM; its message holds what was measured.
    """
    cache = _cache_state()  # before anything is compiled
    mesh = _check(works, asked)
    plan = sorted(((work, seeds) for work in works for seeds in asked.seeds), key=lambda pair: _at_rest(*pair, mesh))
    rows: list[dict[str, Any]] = []
    entry = _entry(asked, command, cache)
    console.print(f"measuring {len(plan)} times: some seconds to compile, then {asked.seconds:g} s of training each")
    with interruptible() as stopping, progress_bars() as bars:
        bar = bars.add_task("bench", total=len(plan), note="")

        def told(name: str, note: str) -> None:
            bars.update(bar, note=f"{name}: {note}")
            if stopping.is_set():
                done = machines.figures(rows) + "\n" if rows else ""
                raise Interrupted(f"{done}stopped after {len(rows)} of {len(plan)} measurements; nothing was written")

        for work, seeds in plan:
            name = f"{work.task.name} {work.preset}, {seeds} seeds"
            rows.append(measure(work, seeds, mesh, asked.seconds, partial(told, name)))
            bars.advance(bar)
    entry["rows"] = sorted(rows, key=lambda row: ([work.task.name for work in works].index(row["task"]), row["seeds"]))
    if asked.out:
        with asked.out.open("x") as file:
            file.write(json.dumps(entry, indent=1) + "\n")
    return entry


def _check(works: Sequence[Work], asked: Measuring) -> Mesh:
    """The devices to measure on. Raises UserError for what cannot be measured."""
    if (
        not asked.seeds
        or len(set(asked.seeds)) < len(asked.seeds)
        or not all(0 < s < LARGEST_SEED for s in asked.seeds)
    ):
        raise UserError(f"--seeds {' '.join(map(str, asked.seeds))}: give different positive numbers")
    if not 0 < asked.seconds < math.inf:
        raise UserError(f"--seconds is {asked.seconds}: give a positive number")
    if not 0 <= asked.devices <= jax.local_device_count():
        raise UserError(f"--devices is {asked.devices}: there are {jax.local_device_count()} (0: all)")
    if asked.out and asked.out.exists():
        raise UserError(f"{asked.out} exists: give another --out")
    if asked.out and not asked.out.parent.is_dir():
        raise UserError(f"{asked.out.parent} is no folder: make it first, or give another --out")
    mesh = lane_mesh(jax.local_devices()[: asked.devices or None])
    for work in works:
        configuration.check(work.config)
        for seeds in asked.seeds:
            console.print(f"{work.task.name} {work.preset}, {memory_report(_planned(work, seeds, mesh))}")
    return mesh


def _planned(work: Work, seeds: int, mesh: Mesh) -> LaneGroup:
    """The lanes of a measurement, of which nothing but shapes is made."""
    env = shape_of(work.task, work.config.task)
    made = guidances.make("none", work.config.sizes, env)
    return LaneGroup(learning(work.config), env, made, Grid(("none",), tuple(range(seeds)), ()), mesh)


def _at_rest(work: Work, seeds: int, mesh: Mesh) -> int:
    """Bytes of all lanes. A device's peak is that of its whole process, so small measurements come first."""
    return sum(state_bytes(block) for block in _planned(work, seeds, mesh).shapes())


def _entry(asked: Measuring, command: str, cache: str) -> dict[str, Any]:
    """Where and how the figures were measured."""
    came = {**provenance(), "command": command}
    return {
        "name": asked.name or (came["hardware"] if jax.default_backend() != "cpu" else f"{CORES} cores"),
        "note": asked.note,
        **came,
        "processor": _processor(),
        "cores": CORES,
        "measured": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "compilation_cache": cache,
        "rows": [],
    }


def _processor() -> str:
    """The processor's own name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.machine())


def _cache_state() -> str:
    """Of JAX's persistent compilation cache: none, empty, or filled."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    if not folder:
        return "none"
    return "filled" if os.path.isdir(folder) and os.listdir(folder) else "empty"


def _rates() -> dict[str, float]:
    """Rates of matrix products [operations/s]; of bfloat16 on accelerators alone."""
    dtypes = ("float32",) if jax.default_backend() == "cpu" else ("float32", "bfloat16")
    return {dtype: matmul_rate(dtype, repeats=3) for dtype in dtypes}


def _timed(work: Callable[[], T]) -> tuple[float, T]:
    """Seconds until everything that `work` returns is there, and that."""
    began = time.perf_counter()
    done = jax.block_until_ready(work())
    return time.perf_counter() - began, done


def _options(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested options as (dotted name, value)."""
    flat = []
    for name, value in values.items():
        flat += _options(value, f"{prefix}{name}.") if isinstance(value, dict) else [(prefix + name, value)]
    return flat
