"""Parse the command line: first a task, preset or run, then options as a dataclass; errors in one line."""

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

from cuelearner_jax import plugins
from cuelearner_jax.adaptation import changes
from cuelearner_jax.cli import pages
from cuelearner_jax.cli.pages import HELP, HELP_ALL, Subject
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError, no_space, suggestion
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import policy_of, teaching
from cuelearner_jax.policies.foreign import ONNX
from cuelearner_jax.run_config import PARTS
from cuelearner_jax.runs.trained import POLICIES, PolicySource
from cuelearner_jax.storage import policy_folders, whole
from cuelearner_jax.task import PAPER, Preset, Task, shape_of
from cuelearner_jax.tasks import registry, shipped
from cuelearner_jax.terminal import PLAIN

TASK_OPTIONS = ("--task", "--env")  # two names of one option


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


def task_of(arguments: list[str], command: str, kind: type) -> tuple[Task, list[str]]:
    """Return the task named first, or by --task or --env, and the other arguments. Raises UserError if unavailable.

    --teacher makes code its teacher.
    """
    given, rest = _task_option(arguments)
    teacher, rest = taken(rest, "--teacher", "package.module:NAME")
    if given is None:
        if not rest or rest[0] in HELP:
            explain(command, kind, "TASK", HELP_ALL in rest)
            raise SystemExit(0 if arguments else 2)
        given, rest = rest[0], rest[1:]
    elif rest and not rest[0].startswith("-"):
        raise UserError(f"the task is named twice, {rest[0]!r} and {given!r}: name it once")
    return _taught(registry.resolve(given), teacher), rest


def preset_of(task: Task, arguments: list[str], default: str = PAPER) -> tuple[str, Preset, list[str]]:
    """Return the preset (default: `default` or the first) and the other arguments. Raises UserError if unknown."""
    if not task.presets and task.name in registry.FAMILIES:
        raise UserError(f"{task.name} is a family of tasks: name one of its environments, as {task.name}:NAME")
    if not task.presets:
        raise UserError(f"{task.name} has no preset to start from: give its Task one")
    name, rest = taken(arguments, "--preset", ", ".join(task.presets))
    name = task.first_preset(default) if name is None else name
    if name not in task.presets:
        raise UserError(f"unknown preset {name!r}{suggestion(name, task.presets)}")
    return name, task.presets[name], rest


def source_of(arguments: list[str], command: str, kind: type) -> tuple[PolicySource, list[str]]:
    """Return the run folder, policy folder or task named first, and the other arguments.

    --task, or --env, makes an outside task known, and a library's environment the world of a folder. --teacher makes
    code its teacher. --agent and --arbiter name a run's outside parts; --base and --changes a policy's code.

    Raises:
        UserError: the folder or task does not exist or is not available.
    """
    given, rest = _task_option(arguments)
    teacher, rest = taken(rest, "--teacher", "package.module:NAME")
    known = None if given is None else registry.resolve(given)
    reference, rest = taken(rest, "--base", "package.module:NAME")
    code = None if reference is None else code_of(reference)
    named, rest = taken(rest, "--changes", "package.module:NAME")
    changed = None if named is None else changes.load(named)
    for name, parts in PARTS.items():
        reference, rest = taken(rest, f"--{name}", "package.module:NAME")
        if reference is not None:
            parts.resolve(reference)
    if known is None and (not rest or rest[0] in HELP):
        explain(command, kind, "FOLDER|TASK", HELP_ALL in rest)
        raise SystemExit(0 if arguments else 2)
    if rest and (known is None or not rest[0].startswith("-")):
        name, rest = rest[0], rest[1:]
        folder = shipped.folder_of(name)
        whole.check_not_aside(folder)
        holds = (folder / "config.json").exists() or policy_folders.is_one(folder)
        if holds or (folder.exists() and name not in registry.names()):
            source = _of_folder(folder, known, code, changed)
            if named is not None and source.adapted is None and command != "adapt":
                raise UserError(f"{folder} is a run, without changes in its policies: leave out --changes")
            return dataclasses.replace(source, task=_taught(source.task, teacher)), rest
        if known is not None:
            raise UserError(f"{name!r} is no run folder of the task {known.name}: give one, or leave it out")
        if ":" not in name and name not in registry.names():
            raise UserError(
                f"{name!r} is neither a run folder nor a task ({', '.join(registry.names())}) "
                f"nor a shipped agent ({', '.join(shipped.names())})"
            )
        known = registry.resolve(name)
    assert known is not None  # otherwise the first argument was taken for its name
    if code is not None:
        raise UserError("--base names the code in a policy folder: give that folder, or leave it out")
    _, preset, rest = preset_of(known, rest)
    return PolicySource(_taught(known, teacher), preset.config, None, Path(known.name)), rest


def world_of(source: PolicySource, arguments: list[str]) -> Any:
    """Return the source's world, changed by --scenario; options on top are parsed from the same arguments later.

    Raises:
        UserError: there is no such scenario.
    """
    name, _ = taken(arguments, "--scenario", ", ".join(source.task.scenarios) or "none")
    return source.config.task if name is None else source.task.scenario(name).apply(source.config.task)


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


def _task_option(arguments: list[str]) -> tuple[str | None, list[str]]:
    choices = f"{', '.join(registry.names())}, or package.module:name"
    found, rest = [], arguments
    for option in TASK_OPTIONS:
        given, rest = taken(rest, option, choices)
        found += [] if given is None else [given]
    if len(found) > 1:
        raise UserError(f"the task is named twice, {found[0]!r} and {found[1]!r}: name it once")
    return (found or [None])[0], rest


def _taught(task: Task, reference: str | None) -> Task:
    """Return the task with the teacher that `package.module:NAME` leads to: a teacher, or a policy used as one.

    Raises UserError if there is none.
    """
    if reference is None:
        return task
    code = plugins.load(reference, object, "a teacher")
    return dataclasses.replace(task, teacher=lambda config, env: teaching(code, actions_of(env)), brief_teacher=None)


def is_code(named: str) -> bool:
    """Return whether a word names a policy that is code: package.module:NAME, or a file in ONNX."""
    if shipped.is_shipped(named):
        return False
    return named.endswith(ONNX) or (bool(plugins.REFERENCE.fullmatch(named)) and not Path(named).exists())


def code_of(reference: str) -> Any:
    """Return the policy of `package.module:NAME` or of a file in ONNX. Raises UserError if there is none."""
    return policy_of(reference if reference.endswith(ONNX) else plugins.load(reference, object, "a policy"))


def _of_folder(folder: Path, known: Task | None, code: Any, changed: Any) -> PolicySource:
    """Open a run or policy folder, for a family of tasks in the environment named beside it.

    Raises UserError for another kind of folder, another task than named, or other observations or actions.
    """
    source = PolicySource.of_folder(folder, registry.find, code, changed)
    if known is not None and known.name != source.task.name:
        what = "a run" if source.grid else "a policy"
        raise UserError(f"{folder} is {what} of {source.task.name}, not of {known.name}: leave out --task")
    if known is not None and known.named:
        before, now = (shape_of(known, config) for config in (source.config.task, known.plain()))
        if (before.obs_size, actions_of(before).size) != (now.obs_size, actions_of(now).size):
            raise UserError(
                f"{folder} acts on observations of {before.obs_size} entries with actions of "
                f"{actions_of(before).size}, {known.named} has {now.obs_size} and {actions_of(now).size}: name another"
            )
        world = dataclasses.replace(source.config, task=known.plain())
        source = dataclasses.replace(source, task=known, config=world)
    return source


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
        "robots (--robot of adapt, evaluate, label and render)": bodies,
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
