"""Parse the options of a command line as a dataclass; errors in one line. See `sources` for what stands first."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import os
import re
import stat
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from cuelearner_jax.cli import pages
from cuelearner_jax.cli.pages import HELP, HELP_ALL, Subject
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.errors import UserError, no_space
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.runs.trained import POLICIES
from cuelearner_jax.task import PAPER, Task
from cuelearner_jax.tasks import registry
from cuelearner_jax.terminal import PLAIN


class _Output(Console):
    """Standard output."""

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError: the reader of the output has gone."""
        raise BrokenPipeError


out = _Output(**PLAIN)


def summary(kind: type) -> str:
    """Return one line about a command: the beginning of its options' docstring."""
    return " ".join(inspect.cleandoc(kind.__doc__ or "").split("\n\n")[0].split())


def parse(
    kind: Any,
    arguments: list[str],
    program: str,
    default: Any = None,
    about: str | None = None,
    subject: Subject | None = None,
) -> Any:
    """Arguments as a dataclass. Raises UserError with tyro's message in one line, or for an `out` that cannot be.

    `program` is the command as its help shows it, `about` the text above the options (default: the kind's docstring),
    `subject` the task or folder that examples name.
    """
    errors = io.StringIO()
    keywords = {
        "prog": f"cuelearner {program}",
        "description": about,
        **({} if default is None else {"default": default}),
    }
    _check_given(arguments)
    helped = [argument for argument in arguments if argument in HELP]
    try:
        if helped and HELP_ALL not in helped:
            text = _whole(lambda: tyro.cli(kind, args=["--help"], **keywords))
            print(pages.first_page(text, pages.command_of(program), f"cuelearner {program}", subject))
            raise SystemExit(0)
        with contextlib.redirect_stderr(errors):
            asked = tyro.cli(kind, args=["--help"] if helped else arguments, **keywords)
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [re.sub(r"^[│╭╰─\s]+|[│╮╯─\s]+$", "", line) for line in errors.getvalue().splitlines()]
        told = " ".join(line for line in lines[1:] if line)
        told = re.split(r"For full helptext|Argument helptext", told)[0].strip()
        told = told.replace("Perhaps you meant:", "; perhaps you meant")
        told = re.sub(r"\s+", " ", told).replace(" ;", ";")[:400]
        told += _moved(told, kind if default is None else default)
        raise UserError(f"{told}; see cuelearner {program} --help") from None
    for part in (asked, *vars(asked).values()):
        if isinstance(place := getattr(part, "out", None), Path):
            default = next(entry.default for entry in dataclasses.fields(part) if entry.name == "out")
            check_out(place, folder=default is not None)  # what may be left out is a file
    return asked


def _moved(told: str, options: Any) -> str:
    """Return a hint at groups that have an option of an unknown group, as the end of a message."""
    unknown = re.search(r"Unrecognized options: --[a-z_-]+\.([a-z0-9-]+)", told)
    there = [name for name in _options(options) if unknown and name.endswith(f".{unknown[1]}")]
    return f"; give --{' or --'.join(there)}" if there else ""


def _options(group: Any, prefix: str = "") -> list[str]:
    """Return the full names of the options in groups."""
    found = []
    for entry in dataclasses.fields(group):
        value, name = getattr(group, entry.name, None), entry.name.replace("_", "-")
        own = prefix if entry.name in ("run", "kinds") else f"{prefix}{name}."
        found += _options(value, own) if dataclasses.is_dataclass(value) else [f"{prefix}{name}"]
    return found


NARROW = 99  # columns within which tyro's help is one column of options


def _whole(tell: Callable[[], Any]) -> str:
    """Return the help that `tell` prints by tyro, in the form that `pages.read` parses."""
    page, before = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(NARROW)
    try:
        with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit):
            tell()
    finally:
        os.environ.pop("COLUMNS") if before is None else os.environ.update(COLUMNS=before)
    return page.getvalue()


@dataclass(frozen=True)
class _Unnamed:
    """Options of a task that is not named yet."""


def explain(command: str, kind: Any, takes: str, whole: bool) -> None:
    """Print the help of a command after which nothing is named yet.

    Args:
        command: its name.
        kind: its options class, generic in the types that a task decides.
        takes: the word for what is named next, such as `TASK`.
        whole: print every task with its choices instead of a first page.
    """
    usage = f"cuelearner {command} {takes} [OPTIONS]"
    if whole:
        print(f"usage: {usage}\n\n{summary(kind)}\n\n{_tasks()}\n")
        print(f"options and their defaults: cuelearner {command} TASK {HELP_ALL}")
        return
    usual = {"out": Path("FOLDER"), "sizes": GuideSizes(), "scalars": GuideScalars()}
    needed = {entry.name for entry in dataclasses.fields(kind) if entry.default is entry.default_factory}
    default = {name: usual.get(name, _Unnamed()) for name in needed | {"kinds"} & _names(kind)}
    filled = kind[(_Unnamed,) * len(kind.__parameters__)]
    text = _whole(lambda: tyro.cli(filled, args=["--help"], prog=usage, default=filled(**default)))
    print(pages.first_page(text, command, f"cuelearner {command} TASK", tasks=registry.names()))


def _names(kind: Any) -> set[str]:
    return {entry.name for entry in dataclasses.fields(kind)}


def check_numbers(asked: Any, **bounds: tuple[int, int]) -> None:
    """Raise UserError for the first option, by its field, that is outside its bounds (least, most)."""
    for name, (least, most) in bounds.items():
        if not least <= (value := getattr(asked, name)) <= most:
            raise UserError(f"--{name} is {value}: give a number from {least} to {most:,}")


def _check_given(arguments: list[str]) -> None:
    """Raise UserError for an option with an empty value, as an unset shell variable gives it."""
    for before, argument in zip(["", *arguments], arguments, strict=False):
        option, equals, value = argument.partition("=")
        if argument == "" or (equals and option.startswith("--") and not value):
            name = option or (before if before.startswith("--") else "an argument")
            raise UserError(f"{name} is empty: give it a value, or leave it out")


def check_out(place: Path, folder: bool = True) -> None:
    """Raise UserError unless a folder (or a file) exists or can be made at a path; leave nothing there."""
    place = Path(os.path.normpath(place.absolute()))
    for there in (place, *place.parents):
        try:
            kept = there.stat()
        except (FileNotFoundError, NotADirectoryError):
            if not there.is_symlink():
                continue
            raise UserError(f"{there} is a link to nothing: give another --out") from None
        except OSError as error:
            raise UserError(f"{place}: {error.strerror}: give another --out") from None
        if (folder or there != place) and not stat.S_ISDIR(kept.st_mode):
            raise UserError(f"{there} is not a folder: give another --out")
        if there == place and not os.access(there, os.W_OK):
            raise UserError(f"{there} may not be written to: give another --out, or have its permissions changed")
        if there != place:
            _try_folder(there)
        return


def _try_folder(there: Path) -> None:
    """Raise UserError unless something can be made in a folder, which permissions alone do not tell."""
    try:
        os.rmdir(tempfile.mkdtemp(prefix=".cuelearner-", dir=there))
    except OSError as error:
        if not no_space(error):
            raise UserError(f"nothing can be made in {there} ({error.strerror}): give another --out") from None


def taken(arguments: list[str], option: str, choices: str) -> tuple[str | None, list[str]]:
    """Return an option's value (None: not given) and the other arguments. Raises UserError if it is given twice."""
    places = [i for i, argument in enumerate(arguments) if argument == option or argument.startswith(f"{option}=")]
    if not places:
        return None, list(arguments)
    if len(places) > 1:
        raise UserError(f"{option} is given twice: give it once")
    (place,) = places
    if "=" in arguments[place]:
        return arguments[place].partition("=")[2], arguments[:place] + arguments[place + 1 :]
    if place + 1 == len(arguments):
        raise UserError(f"{option} needs a name: choose one of {choices}")
    return arguments[place + 1], arguments[:place] + arguments[place + 2 :]


def about(kind: type, task: Task, policies: bool = False, preset: str = PAPER) -> str:
    """Return the text above a command's options: its purpose, and the available choices."""
    groups = {"guidance (--guidance; your own as package.module:NAME)": {k.name: k.about for k in guidances.kinds()}}
    if policies:
        trained = {name: named.about for name, named in POLICIES.items() if named.trained}
        adapted = {name: named.about for name, named in POLICIES.items() if named.adapted}
        untrained = {name: named.about for name, named in POLICIES.items() if not named.kept}
        groups |= {"policies of a run (--policy)": trained, "policies of a policy folder": adapted}
        groups |= {"policies of any folder or a task alone": untrained}
    told = [summary(kind), _choices(task, preset), *(f"{title}:\n{_rows(rows)}" for title, rows in groups.items())]
    return "\n\n".join(told)


def _tasks() -> str:
    """Return every task with its choices."""
    told = []
    for name in registry.names():
        try:
            task = registry.find(name)
        except UserError as error:  # of a package that is damaged: the others can still be named
            told.append(f"task {name}: {error}\n")
            continue
        told.append(f"task {name}: {task.about}\n\n{_choices(task)}\n")
    own = "a task of your own: package.module:NAME, also as --task package.module:NAME (--env names a task as well)"
    return "\n".join([*told, own])


def _choices(task: Task, preset: str = PAPER) -> str:
    """Return a task's presets, changed worlds and robots, one line each; `preset`: the default preset."""
    scenarios = {name: f"{one.about} ({_as_options(one.changes)})" for name, one in task.scenarios.items()}
    bodies = {body.name: body.about for body in task.bodies} if len(task.bodies) > 1 else {}
    presets = {name: f"{one.about}{f' ({one.takes})' if one.takes else ''}" for name, one in task.presets.items()}
    default = f"; {task.first_preset(preset)} where none is given" if presets else ""
    groups = {
        f"presets (--preset{default})": presets,
        "changed worlds (--scenario of adapt, evaluate and render)": scenarios,
        "robots (--robot)": bodies,
    }
    # A line that is not indented would be taken for the end of the one above: the groups stand apart.
    return "\n\n".join(f"{title}:\n{_rows(rows)}" for title, rows in groups.items() if rows)


def _as_options(changes: dict[str, Any]) -> str:
    """Return fields of a configuration as command-line options."""
    typed = {name: value if isinstance(value, tuple) else (value,) for name, value in changes.items()}
    return " ".join(f"--task.{name.replace('_', '-')} {' '.join(map(str, value))}" for name, value in typed.items())


def _rows(told: dict[str, str]) -> str:
    width = max(map(len, told), default=0) + 2
    return "\n".join(f"  {name:<{width}}{text}" for name, text in told.items())
