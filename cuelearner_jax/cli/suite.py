"""`cuelearner suite`."""

from __future__ import annotations

import shlex
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cuelearner_jax import signals
from cuelearner_jax.cli.options import look_ahead, out, parse
from cuelearner_jax.cli.sources import preset_of, source_of
from cuelearner_jax.config import plain
from cuelearner_jax.errors import NotFinite, UserError, suggestion
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.report import suite as page
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.storage import table as tables
from cuelearner_jax.studies import suite
from cuelearner_jax.studies.suite import ADAPT, RIGHT, TABLE, World
from cuelearner_jax.task import QUICKSTART
from cuelearner_jax.tasks.presets import GROUPS, with_groups


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Run a fixed set of tasks, kinds of guidance, label budgets and teachers, and write one table and one page.

    The same command goes on where it stopped."""

    scale: str = "smoke"
    """What to run: smoke (minutes), quick (two hours on 2 cores), paper (an accelerator, in pieces)."""
    out: Path = Path("runs/suite")
    """Folder for cells, suite.parquet and the page."""
    guidance: tuple[str, ...] = ()
    """Kinds of guidance beside those of the scale; your own as package.module:NAME."""
    minutes: float | None = None
    """Stop after so many minutes, with all work saved."""
    shard: str | None = None
    """Run only the cells of shard i of n, given as i/n."""
    table: Path = TABLE
    """Another table of worlds, teachers and scales, in TOML."""


def run(arguments: list[str]) -> None:
    """Run the command. Raises UserError for bad input before anything is changed."""
    options = parse(Suite, arguments, "suite")
    table = _read(options.table)
    if options.scale not in table["scales"]:
        raise UserError(f"unknown scale {options.scale!r}{suggestion(options.scale, table['scales'])}")
    if options.minutes is not None and not options.minutes > 0:
        raise UserError(f"--minutes is {options.minutes:g}: give a number above 0")
    scale, shard = table["scales"][options.scale], Shard.parse(options.shard or "1/1")
    kinds = [guidances.resolve(kind).name for kind in (*scale.get("kinds", table["kinds"]), *options.guidance)]
    try:
        worlds = [_world(name, table["worlds"][name] | own) for name, own in scale["worlds"].items()]
        cells = suite.cells_of(table, scale, worlds, list(dict.fromkeys(kinds)))
    except KeyError as error:
        raise UserError(f"--table {options.table} has no {error}, which {options.scale} needs") from error
    obstacles = [cell.obstacle() for cell in cells]
    sensible = [cell for cell, obstacle in zip(cells, obstacles, strict=True) if obstacle is None]
    _claim(options.out, f"# {options.scale}\n{options.table.read_text(encoding='utf-8')}")
    with _deadline(options.minutes) as is_over:
        for number, cell in enumerate(sensible):
            if number % shard.count != shard.index - 1 or suite.is_done(options.out, cell):
                continue
            if is_over():
                break
            out.print(f"{number + 1} of {len(sensible)}: {cell.name}")
            try:
                cell.run(options.out)
            except NotFinite as error:
                out.print(str(error))
            except signals.Interrupted as end:
                if not is_over():
                    end.args = ("stopped, with all work saved; the same command goes on",)
                    raise
    done = sum(suite.is_done(options.out, cell) for cell in sensible)
    out.print(
        f"{done} of {len(sensible)} cells are done{'' if done == len(sensible) else '; the same command goes on'}"
    )
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
        out.print(f"wrote {page.write(options.out, rows, RIGHT, lines, command)}")


def _read(path: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"--table {path} cannot be read ({error}): give a table in TOML as {TABLE.name}") from error
    if absent := {"kinds", "teachers", "worlds", "scales"} - table.keys():
        raise UserError(f"--table {path} has no {sorted(absent)[0]}: give a table as {TABLE.name}")
    return table


def _world(name: str, values: dict[str, Any]) -> World:
    """Return a world of the table. Raises UserError for a task, preset or scenario that does not exist."""
    values, groups = dict(values), {group: values[group] for group in GROUPS if group in values}
    source, start = source_of(look_ahead(shlex.split(values["subject"]))), values.get("scenario")
    config = source.config
    if values["use"] == ADAPT:
        changes = source.task.scenario(start).changes if start else {}
        config = replace(config, task=replace(config.task, **changes))
        sizes = {key: plain(value) for key, value in groups.pop("sizes", {}).items()}
    else:
        start, preset = preset_of(source.task, values.get("preset"), QUICKSTART)
        config, sizes = preset.config, {}
    config = with_groups(config, groups)
    start = start or ", ".join(f"{key}={value}" for key, value in groups.get("task", {}).items())
    return World(name, values["use"], start, values["metric"], config, source, sizes, values.get("bound"))


def _claim(folder: Path, text: str) -> None:
    """Write what a folder's suite is, or raise UserError if it is another one."""
    path = folder / "suite.toml"
    if path.exists() and path.read_text(encoding="utf-8") != text:
        raise UserError(f"{folder} holds a suite of another scale or table: give another --out")
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


@contextmanager
def _deadline(minutes: float | None) -> Iterator[Any]:
    """Yield whether the time is over; work in progress that can be saved is then asked to end."""
    end, closed = time.monotonic() + 60 * (minutes or float("inf")), threading.Event()
    is_over = lambda: time.monotonic() > end  # noqa: E731

    def watch() -> None:
        while not closed.wait(0.5):
            if is_over():
                signals.finish_work()

    threading.Thread(target=watch, name="deadline", daemon=True).start()
    try:
        yield is_over
    finally:
        closed.set()
