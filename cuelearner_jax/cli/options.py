"""Options that several commands share, and how a command line becomes a dataclass: a field is an option.

A task, a preset or a kind of guidance decides which other options there are. So `look_ahead` reads those words first;
from them a command makes the default options, whose types tyro turns into the command's options.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import os
import re
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from cuelearner_jax.api.worlds import NoOptions
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.runs.policy_sources import POLICIES
from cuelearner_jax.task import PAPER, Task
from cuelearner_jax.tasks import registry
from cuelearner_jax.terminal import PLAIN

Flag = tyro.conf.FlagCreatePairsOff
Word = Annotated[str | None, tyro.conf.Positional]
unprefixed = tyro.conf.arg(name="")
Kinds = Annotated[dict[str, Any], unprefixed]  # options of kinds of guidance, named `--KIND.…`


class _Output(Console):
    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError: the reader of the output has gone."""
        raise BrokenPipeError

    def print_table(self, table: Table) -> None:
        """Print a table whole: plain, a row a line, where there is no terminal or the table is wider than it."""
        below, table.caption = table.caption, None
        width = self.measure(table, options=self.options.update(max_width=10_000)).maximum
        if not self.is_terminal or width > self.width:
            table.box = None
        _Output(file=self.file, width=max(width, self.width), **PLAIN).print(table)
        if below:
            self.print(below)


out = _Output(**PLAIN)


def _whole(words: list[str]) -> int:
    """Return a whole number, which may have an exponent. Raises ValueError for any other word."""
    number = float(words[0]) if "e" in words[0].lower() else int(words[0])
    if number != int(number):
        raise ValueError(f"{words[0]} is not a whole number")
    return int(number)


WHOLE = tyro.constructors.PrimitiveConstructorSpec(
    1, "INT", _whole, lambda value: type(value) is int, lambda one: [str(one)]
)
NUMBERS = tyro.constructors.ConstructorRegistry()
NUMBERS.primitive_rule(lambda info: WHOLE if info.type is int else None)


@dataclass(frozen=True, kw_only=True)
class Outside:
    """The subject of a command, and the code and worlds that it names."""

    subject: Annotated[Word, tyro.conf.arg(metavar="TASK|FOLDER")] = None
    """A task by its name, as package.module:NAME or as gymnasium:FetchReach-v4; or a run folder, a policy folder or a
    shipped agent, for commands about finished policies."""
    env: Annotated[str | None, tyro.conf.arg(aliases=("--task",))] = None
    """World: a task, or a library's environment, as gymnasium:FetchReach-v4 (--task is another name of this option)."""
    teacher: str | None = None
    """Your own teacher: package.module:NAME of a function of observations, a policy or a teacher (default: the
    task's)."""
    preset: str | None = None
    """Preset of the task, by its name."""


@dataclass(frozen=True, kw_only=True)
class RunParts:
    """A run's parts from outside the package, or other parts than the preset's."""

    agent_part: Annotated[str | None, tyro.conf.arg(name="agent")] = None
    """Agent: ddqn, sac, or package.module:NAME of your own."""
    arbiter_part: Annotated[str | None, tyro.conf.arg(name="arbiter")] = None
    """Arbiter, by its name, or package.module:NAME of your own."""


@dataclass(frozen=True, kw_only=True)
class NewWorld(Outside):
    """The world that a finished policy meets."""

    task: Any = field(default_factory=NoOptions)
    scenario: str | None = None
    """A changed world, by its name. Options of the task (--task.…) come on top of it."""
    robot: str | None = None
    """Another robot, by its name (default: the task's own). With a folder, as anymal:FOLDER: one with your own walking
    policy."""
    changes: str | None = None
    """Distortions of your own that a reading of answers knows, in place of those that the world declares:
    package.module:NAME."""
    code: Annotated[str | None, tyro.conf.arg(name="base")] = None
    """Code of a policy folder's base policy: package.module:NAME."""


@dataclass(frozen=True, kw_only=True)
class Finished(NewWorld, RunParts):
    """A finished policy's code, which is never loaded because a file names it, and its world."""


ONE = ("teacher", "preset", "scenario", "agent", "arbiter", "base", "changes", "labels-from", "judge-by", "cues")


class _Ahead(argparse.ArgumentParser):
    def error(self, message: str) -> Any:
        raise UserError(message.removeprefix("argument "))


def look_ahead(arguments: list[str]) -> argparse.Namespace:
    """Return the options that decide which other options there are, and the words before the first option as `words`.

    An option that is not given is None. Raises UserError for an option without its value.
    """
    parser = _Ahead(add_help=False, allow_abbrev=False)
    parser.add_argument("--env", "--task")
    for name in (*ONE, "again", "task.actions", "task.arguments"):
        parser.add_argument(f"--{name}")
    for name, kind in {"guidance": str, "task.low": float, "task.high": float}.items():
        parser.add_argument(f"--{name}", nargs="*", type=kind)
    ahead, rest = parser.parse_known_args(arguments)
    ahead.words = list(takewhile(lambda word: not word.startswith("-"), rest))
    return ahead


def look_ahead_of(arguments: list[str], command: str, kind: type) -> argparse.Namespace:
    """Return `look_ahead`'s options. Where nothing is named, print help (SystemExit) or raise UserError."""
    ahead = look_ahead(arguments)
    alone = command == "adapt" and ahead.labels_from is not None  # labels about proposed actions name their task
    if alone or ahead.words or ahead.env:
        return ahead
    tasks = ", ".join(registry.names())
    if {"-h", "--help"} & {*arguments}:
        about = f"{inspect.getdoc(kind)}\n\ntasks: {tasks}; or one of your own, as package.module:NAME\n\n"
        parse(kind, ["--help"], command, kind(), f"{about}With a task, --help lists the task's options too.")
    raise UserError(f"{command} needs a subject: name a task ({tasks}) or a folder; see cuelearner {command} --help")


def parse(kind: Any, arguments: list[str], command: str, default: Any = None, about: str = "") -> Any:
    """Return arguments as a dataclass. Raises UserError with tyro's message in one line, or for an impossible `out`.

    `about`: the text above the options (default: the docstring of `kind`).
    """
    errors = io.StringIO()
    values: dict[str, Any] = {"registry": NUMBERS} | ({} if default is None else {"default": default})
    try:
        with contextlib.redirect_stderr(errors):
            options = tyro.cli(kind, args=arguments, prog=f"cuelearner {command}", description=about or None, **values)
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [re.sub("[-─]{3,}", "", line).strip("│╭╮╰╯|+ ") for line in errors.getvalue().splitlines()]
        message = re.split("For full helptext|Argument helptext", " ".join(" ".join(lines[1:]).split()))[0].strip()
        raise UserError(f"{message}; see cuelearner {command} --help") from None
    if (place := getattr(options, "out", None)) is not None:
        there = next(parent for parent in place.absolute().parents if parent.exists())
        if not there.is_dir() or not os.access(there, os.W_OK):
            raise UserError(f"{there} is not a folder that may be written to: give another --out")
    return options


def check_numbers(options: Any, **bounds: tuple[float, float]) -> None:
    """Raise UserError for the first option, by its field, that is outside its bounds (least, most)."""
    for name, (least, most) in bounds.items():
        if not least <= (value := getattr(options, name)) <= most:
            raise UserError(f"--{name} is {value}: give a number from {least} to {most:,}")


def about(kind: type, task: Task, policies: bool = False, preset: str = PAPER) -> str:
    """Return the text above a command's options: its purpose and the names to choose from. `preset`: the default."""
    presets = {name: f"{one.about}{f' ({one.takes})' if one.takes else ''}" for name, one in task.presets.items()}
    default = f"; {task.first_preset(preset)} where none is given" if presets else ""
    groups = {
        f"presets (--preset{default})": presets,
        "changed worlds (--scenario)": {
            name: f"{one.about} ({' '.join(as_options('task', one.changes))})" for name, one in task.scenarios.items()
        },
        "robots (--robot)": {body.name: body.about for body in task.bodies if len(task.bodies) > 1},
        "guidance (--guidance; your own as package.module:NAME)": {
            name: one.about for name, one in guidances.guides().items()
        },
        "policies (--policy)": {name: one.about for name, one in POLICIES.items() if policies},
    }
    # A line that is not indented would be taken for the end of the one above: the groups stand apart.
    sections = (f"{title}:\n{rows(texts)}" for title, texts in groups.items() if texts)
    return "\n\n".join([str(inspect.getdoc(kind)), *sections])


def as_options(part: str, values: dict[str, Any]) -> list[str]:
    """Return the words of a command line that give fields of one part of a configuration their values."""
    words = []
    for name, value in values.items():
        option = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{part}.{option}" if value else f"--{part}.no-{option}")
        else:
            words += [f"--{part}.{option}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words


def rows(texts: dict[str, str]) -> str:
    """Return names and their texts, a line each."""
    width = max(map(len, texts)) + 2
    return "\n".join(f"  {name:<{width}}{text}" for name, text in texts.items())
