"""`cuelearner bench`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Generic

import tyro

from cuelearner_jax.bench import known_machines, measuring
from cuelearner_jax.bench.measuring import Measuring
from cuelearner_jax.cli.parsing import out, parse, preset_of, task_of
from cuelearner_jax.cli.shared_options import Flag, TaskT
from cuelearner_jax.config import RunConfig
from cuelearner_jax.tasks import registry


@dataclass(frozen=True)
class Bench:
    """Throughput, memory a seed and share of peak of this machine, beside known machines.

    Measures the small presets (quickstart) of the package's tasks, which takes about a minute. Name a task first to
    measure one configuration: cuelearner bench billiards --preset paper --seeds 8 75
    """

    measuring: Annotated[Measuring, tyro.conf.arg(name="")] = field(default_factory=Measuring)
    full: Flag[bool] = False
    """The paper-sized presets instead (paper); minutes."""
    add: Path | None = None
    """Measure nothing: take this file, which --out wrote, into the table of known machines."""


@dataclass(frozen=True)
class BenchTask(Generic[TaskT]):
    """Measure one configuration."""

    run: Annotated[RunConfig[TaskT], tyro.conf.arg(name="")]
    measuring: Annotated[Measuring, tyro.conf.arg(name="")] = field(default_factory=Measuring)


OPTIONS = {"bench": Bench}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises UserError for what cannot be measured."""
    named = any(argument == "--task" or argument.startswith("--task=") for argument in arguments)
    if named or (arguments and not arguments[0].startswith("-")):
        task, rest = task_of(arguments, "bench", Bench)
        name, preset, rest = preset_of(task, rest)
        kind = BenchTask[task.config]  # pyright: ignore[reportInvalidTypeArguments]
        asked = parse(kind, rest, f"bench {task.name}", kind(preset.config))
        works = [measuring.Work(task, name, asked.run)]
    else:
        asked = parse(Bench, arguments, "bench")
        if asked.add:
            known_machines.add(asked.add)
            out.print(f"{known_machines.TABLE.name} holds {asked.add} now")
            return
        name = "paper" if asked.full else "quickstart"
        tasks = [registry.find(task) for task in registry.BUILT_IN]
        works = [measuring.Work(task, name, task.presets[name].config) for task in tasks if name in task.presets]
    known = known_machines.read()
    entry = measuring.run(works, asked.measuring, shlex.join(["cuelearner", "bench", *_without_out(arguments)]))
    out.print(known_machines.figures(entry["rows"]), known_machines.beside(entry, known), sep="\n\n")
    if asked.measuring.out:
        out.print(f"wrote {asked.measuring.out}")


def _without_out(arguments: list[str]) -> list[str]:
    """Arguments less --out and its path, which change no figure."""
    given = [
        not (a.startswith("--out=") or "--out" in arguments[max(i - 1, 0) : i + 1]) for i, a in enumerate(arguments)
    ]
    return [argument for argument, keep in zip(arguments, given, strict=True) if keep]
