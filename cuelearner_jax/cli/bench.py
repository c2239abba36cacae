"""`cuelearner bench`."""

from __future__ import annotations

import json
import math
import shlex
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Generic

import jax
import tyro
from jax.sharding import Mesh

from cuelearner_jax.cli import pages
from cuelearner_jax.cli.parsing import out, parse
from cuelearner_jax.cli.shared_options import RunT, as_kept, parts_of, typed_name
from cuelearner_jax.cli.sources import preset_of, task_of
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.errors import UserError
from cuelearner_jax.run_config import RunConfig, check
from cuelearner_jax.runs import speed
from cuelearner_jax.runs.grid import LARGEST_SEED
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.studies.train import preset_kinds
from cuelearner_jax.task import QUICKSTART, Task
from cuelearner_jax.tasks import registry
from cuelearner_jax.terminal import Interrupted, interruptible, progress_bars

COLUMNS = {  # column -> name and format of its measurement
    "steps/s": ("steps_a_second", ",.0f"),
    "ms/step": ("ms_a_step", ".3f"),
    "MB/seed": ("mb_a_seed", ".2f"),
    "peak GB": ("peak_gb", ".2f"),
    "first step s": ("first_step_s", ".1f"),
}


@dataclass(frozen=True)
class Measuring:
    """Options of a measurement."""

    seeds: tuple[int, ...] = (8,)
    """Numbers of seeds to train at once, over all devices; one measurement for each."""
    seconds: float = 2.0
    """Time of each measurement after compilation [s]; at least three stretches are measured."""
    devices: int = 0
    """Number of devices that share the seeds (0: all)."""
    out: Path | None = None
    """JSON file for the results (default: none)."""


@dataclass(frozen=True)
class Bench(Measuring):
    """Measure this machine: steps per second, memory per seed, time to the first step.

    Trains the small presets (quickstart) of the package's tasks, which takes about a minute. Name a task first to
    measure one configuration: cuelearner bench billiards --preset paper --seeds 8 75
    """


@dataclass(frozen=True)
class BenchTask(Generic[RunT]):
    """Measure one configuration."""

    run: Annotated[RunT, tyro.conf.arg(name="")]
    measuring: Annotated[Measuring, tyro.conf.arg(name="")] = field(default_factory=Measuring)


OPTIONS = {"bench": Bench}


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for an invalid request."""
    works: list[tuple[Task, str, RunConfig]]
    named = any(argument == "--task" or argument.startswith("--task=") for argument in arguments)
    if named or (arguments and not arguments[0].startswith("-")):
        task, rest = task_of(arguments, "bench", Bench)
        name, preset, rest = preset_of(task, rest, QUICKSTART)
        config, run_type, rest = parts_of(preset.config, rest, preset_kinds(task, preset))
        kind = BenchTask[run_type]  # pyright: ignore[reportInvalidTypeArguments]
        subject = pages.subject_of(typed_name(task), task.name, task)
        given = parse(kind, rest, f"bench {subject.typed}", kind(config), subject=subject)
        asked, works = given.measuring, [(task, name, as_kept(given.run))]
    else:
        asked = parse(Bench, arguments, "bench")
        tasks = [registry.find(task) for task in registry.BUILT_IN if task not in registry.FAMILIES]
        works = [(task, QUICKSTART, task.presets[QUICKSTART].config) for task in tasks]
    mesh = _check(asked, works)
    rows: list[dict[str, Any]] = []
    # ascending, since a device's peak memory never falls again
    plan = [(*work, seeds) for work in works for seeds in sorted(asked.seeds)]
    with interruptible() as stopping, progress_bars() as bars:
        bar = bars.add_task("bench", total=len(plan), note="")

        def watch(name: str, note: str) -> None:
            bars.update(bar, note=f"{name}: {note}")
            if stopping.is_set():
                raise Interrupted(f"stopped after {len(rows)} of {len(plan)} measurements; nothing was written")

        for task, preset, config, seeds in plan:
            env = partial(task.environment, config.task)
            told = partial(watch, f"{task.name} {preset}, {seeds} seeds")
            found = speed.measure(config, env, seeds, asked.seconds, mesh, told)
            rows.append({"task": task.name, "preset": preset, **found})
            bars.advance(bar)
    out.print(_table(rows))
    if asked.out:
        told = {**provenance(), "command": shlex.join(["cuelearner", "bench", *arguments]), "rows": rows}
        with asked.out.open("x", encoding="utf-8") as file:
            file.write(json.dumps(told, indent=1) + "\n")
        out.print(f"wrote {asked.out}")


def _check(asked: Measuring, works: list[tuple[Task, str, RunConfig]]) -> Mesh:
    """Return the devices to measure on. Raises UserError for invalid options, or too little free memory."""
    if (
        not asked.seeds
        or len(set(asked.seeds)) < len(asked.seeds)
        or not all(0 < s < LARGEST_SEED for s in asked.seeds)
    ):
        raise UserError(f"--seeds {' '.join(map(str, asked.seeds))}: give different positive numbers")
    if not 0 < asked.seconds < math.inf:
        raise UserError(f"--seconds is {asked.seconds}: give a positive number")
    if not 0 <= asked.devices <= jax.local_device_count():
        raise UserError(f"--devices is {asked.devices}: give at most {jax.local_device_count()} (0: all)")
    if asked.out and asked.out.exists():
        raise UserError(f"{asked.out} exists: give another --out")
    mesh = lane_mesh(jax.local_devices()[: asked.devices or None])
    for *_, config in works:
        check(config)
    return mesh


def _table(rows: list[dict[str, Any]]) -> str:
    """Return measured rows as a text table."""
    lines = [["task", "preset", "seeds", *COLUMNS]]
    for row in rows:
        cells = ["-" if row[name] is None else format(row[name], form) for name, form in COLUMNS.values()]
        lines.append([row["task"], row["preset"], str(row["seeds"]), *cells])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.rjust, line, widths)) for line in lines)
