"""`cuelearner suite`."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax

from cuelearner_jax import devices, signals
from cuelearner_jax.adaptation import by_model
from cuelearner_jax.cli.options import check_numbers, look_ahead, out, parse
from cuelearner_jax.cli.sources import preset_of, source_of
from cuelearner_jax.config import check_part, plain
from cuelearner_jax.errors import NotFinite, UserError, suggestion
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.report import suite as page
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.whole import hold, replacing
from cuelearner_jax.studies import suite
from cuelearner_jax.studies.suite import ADAPT, TABLE, Cell, World
from cuelearner_jax.task import QUICKSTART
from cuelearner_jax.tasks.presets import GROUPS, with_groups

STOPPED = "stopped, with all work saved; the same command goes on"
KEYS = ("use", "subject", "preset", "scenario", "metric", "ends", "bound")  # of a world, beside groups of options
WORKS_FOR = "CUELEARNER_SUITE_WORKS_FOR"  # environment variable of a process of the suite: the process it works for


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Run a fixed set of tasks, kinds of guidance, label budgets and teachers, and write one table and one page.

    The same command goes on where it stopped."""

    scale: str = "smoke"
    """What to run: smoke (minutes), quick (hours on 2 cores), paper (an accelerator, in pieces)."""
    out: Path = Path("runs/suite")
    """Folder for cells, suite.parquet and the page."""
    guidance: tuple[str, ...] = ()
    """Kinds of guidance beside those of the scale; your own as package.module:NAME."""
    minutes: float = float("inf")
    """Stop after so many minutes, with all work saved."""
    processes: int = 0
    """Processes that divide the cells (0: on a CPU one a core, on an accelerator one)."""
    table: Path = TABLE
    """Another table of worlds, teachers and scales, in TOML."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for bad input before anything is changed."""
    options = parse(Suite, arguments, "suite")
    table = _read(options.table)
    if options.scale not in table["scales"]:
        raise UserError(f"unknown scale {options.scale!r}{suggestion(options.scale, table['scales'])}")
    check_numbers(options, minutes=(0.1, float("inf")), processes=(0, 1_000))
    scale = table["scales"][options.scale]
    kinds = [guidances.resolve(kind).name for kind in (*scale.get("kinds", table["kinds"]), *options.guidance)]
    try:
        worlds = [_world(name, _joined(table["worlds"][name], own)) for name, own in scale["worlds"].items()]
        cells = suite.cells_of(table, scale, worlds, list(dict.fromkeys(kinds)))
        for cell in cells:
            check_part(cell.config().scalars, f"teachers.{cell.teacher}")
            replace(by_model.SIZES, **cell.world.sizes)
    except KeyError as error:
        raise UserError(f"--table {options.table} has no {error}, which {options.scale} needs") from error
    except TypeError as error:
        raise UserError(f"--table {options.table} names a field that does not exist: {error}") from error
    obstacles = [cell.obstacle() for cell in cells]
    sensible = [cell for cell, obstacle in zip(cells, obstacles, strict=True) if obstacle is None]
    _claim(options.out, f"# {options.scale}\n{options.table.read_text(encoding='utf-8')}")
    left = {(cell.world.name, cell.kind) for cell in sensible if not suite.is_done(options.out, cell)}
    count = min(len(left), options.processes or (devices.CORES if jax.default_backend() == "cpu" else 1))
    failure = None
    if count > 1:
        failure = _run_in_processes(count, arguments, options.out, scale.get("is_short", False))
    else:
        _run_cells(sensible, options)
    if WORKS_FOR in os.environ:
        return
    done = sum(suite.is_done(options.out, cell) for cell in sensible)
    out.print(f"{done} of {len(sensible)} cells are done" + "; the same command goes on" * (done < len(sensible)))
    if done:
        rows = suite.collect(options.out, worlds)
        tables.write(options.out / "suite.parquet", rows)
        lines = [
            f"- scale {options.scale}, {done} of {len(sensible)} cells; {scale['seeds']} seeds",
            f"- labels {', '.join(map(str, scale['labels']))}; with faulty teachers "
            f"{', '.join(map(str, scale['fault_labels']))}; teachers {', '.join(scale['teachers'])}",
            f"- tasks {', '.join(f'{world.name} ({world.use}, {world.metric})' for world in worlds)}",
            *(f"- left out: {line}" for line in dict.fromkeys(filter(None, obstacles))),
        ]
        command = shlex.join(["cuelearner", "suite", *arguments])
        out.print(f"wrote {page.write(options.out, rows, scale['teachers'][0], lines, command)}")
    if failure:
        raise UserError(failure)


def _run_cells(cells: list[Cell], options: Suite) -> None:
    """Run cells that are not done and whose world and kind no other process has taken, until the time is over."""
    own: set[str] = set()  # names of the locks that this process holds
    with ExitStack() as locks, _deadline(options.minutes) as is_over:

        def take(cell: Cell) -> bool:
            name = f".{cell.world.name}_{cell.kind}.lock"
            with suppress(UserError):  # another process holds it
                if name not in own:
                    locks.enter_context(hold(options.out / name, options.out))
                    own.add(name)
            return name in own

        for number, cell in enumerate(cells):
            if not take(cell) or suite.is_done(options.out, cell):
                continue
            if is_over():
                break
            out.print(f"{number + 1} of {len(cells)}: {cell.name}")
            try:
                cell.run(options.out)
            except NotFinite as error:
                out.print(str(error))
            except signals.Interrupted as end:
                if not is_over():
                    end.args = (STOPPED,)
                    raise


def _run_in_processes(count: int, arguments: list[str], folder: Path, is_short: bool) -> str | None:
    """Run the command in processes that take its cells; each writes a log into the folder.

    Those of a short scale compile in half the time, and their programs run slower. Returns a message if a process
    failed. Raises Interrupted after a signal.
    """
    flags = ["--xla_backend_optimization_level=0"] * is_short
    if is_short and jax.__version_info__ < (0, 11):  # JAX does not start with a flag that it no longer knows
        flags.append("--xla_cpu_use_fusion_emitters=false")
    xla_flags = " ".join([*flags, os.environ.get("XLA_FLAGS", "")])
    variables = {**os.environ, WORKS_FOR: str(os.getpid()), "XLA_FLAGS": xla_flags}
    command = [sys.executable, "-u", "-m", "cuelearner_jax.cli", "suite", *arguments, "--processes", "1"]
    logs = [folder / f"process_{number}.log" for number in range(1, count + 1)]
    with ExitStack() as files, signals.interruptible("the work of all processes") as stopping:
        start = partial(subprocess.Popen[bytes], stderr=subprocess.STDOUT, start_new_session=True, env=variables)
        workers = [start(command, stdout=files.enter_context(log.open("w", encoding="utf-8"))) for log in logs]
        out.print(f"{count} processes run the cells: {logs[0]} ...")
        while not stopping.is_set() and any(worker.poll() is None for worker in workers):
            time.sleep(0.5)
        for worker in workers:
            worker.send_signal(signal.SIGINT)  # nothing happens to one that has ended
        statuses = [worker.wait() for worker in workers]
        if stopping.is_set():
            raise signals.Interrupted(STOPPED)
    for log, status in zip(logs, statuses, strict=True):
        if status:
            return f"a process ended with status {status}: see the end of {log}, and then give the same command"
    return None


def _read(path: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"--table {path} cannot be read ({error}): give a table in TOML as {TABLE.name}") from error
    if absent := {"kinds", "teachers", "worlds", "scales"} - table.keys():
        raise UserError(f"--table {path} has no {sorted(absent)[0]}: give a table as {TABLE.name}")
    return table


def _joined(world: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return a world with a scale's own keys; of a group of options a scale names those that differ."""
    return world | {key: world.get(key, {}) | value if isinstance(value, dict) else value for key, value in own.items()}


def _world(name: str, values: dict[str, Any]) -> World:
    """Return a world of the table. Raises UserError for a task, preset or scenario that does not exist."""
    if unknown := sorted(values.keys() - {*KEYS, *GROUPS}):
        raise UserError(f"world {name} of the table has {unknown[0]!r}{suggestion(unknown[0], [*KEYS, *GROUPS])}")
    if values["use"] not in suite.USES:
        raise UserError(f"world {name} of the table has use {values['use']!r}: give {' or '.join(suite.USES)}")
    groups = {group: values[group] for group in GROUPS if group in values}
    source, start = source_of(look_ahead(shlex.split(values["subject"]))), values.get("scenario")
    config = source.config
    if values["use"] == ADAPT:
        config = replace(config, task=source.task.scenario(start).apply(config.task)) if start else config
        sizes = {key: plain(value) for key, value in groups.pop("sizes", {}).items()}
    else:
        start, preset = preset_of(source.task, values.get("preset"), QUICKSTART)
        config, sizes = preset.config, {}
    config = with_groups(config, groups)
    start = start or ", ".join(f"{key}={value}" for key, value in groups.get("task", {}).items())
    ends = tuple(values.get("ends", (0.0, 1.0)))
    return World(name, values["use"], start, values["metric"], ends, config, source, sizes, values.get("bound"))


def _claim(folder: Path, text: str) -> None:
    """Write what a folder's suite is, or raise UserError if it is another one."""
    path = folder / "suite.toml"
    folder.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        with replacing(path) as file:  # another process may read it
            file.write(text)
    elif path.read_text(encoding="utf-8") != text:
        raise UserError(f"{folder} holds a suite of another scale or table: give another --out")


@contextmanager
def _deadline(minutes: float) -> Iterator[Any]:
    """Yield whether the time or the process that this one works for is over; work is then asked to end and be saved."""
    end, closed = time.monotonic() + 60 * minutes, threading.Event()

    def is_over() -> bool:
        return time.monotonic() > end or os.environ.get(WORKS_FOR) not in (None, str(os.getppid()))

    def watch() -> None:
        while not closed.wait(0.5):
            if is_over():
                signals.finish_work()

    threading.Thread(target=watch, name="deadline", daemon=True).start()
    try:
        yield is_over
    finally:
        closed.set()
