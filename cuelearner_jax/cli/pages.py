"""First pages of help: at most 40 lines of 100 columns, with three examples and the options that people set.

Everything else stands on the page that `--help-all` prints.
"""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

HELP, HELP_ALL = ("-h", "--help", "--help-all"), "--help-all"
LINES, COLUMNS = 40, 100  # of a first page
INDENT = 24  # of texts


class Example(NamedTuple):
    """A command line that runs, and what it is for."""

    about: str
    command: str  # without `cuelearner`


class Page(NamedTuple):
    """The content of a command's first page."""

    options: tuple[str, ...]  # without the dashes, in the order of the page
    examples: tuple[Example, ...]  # where nothing is named yet
    of_subject: tuple[Example, ...] = ()  # where a task or a folder is named: templates, see `examples_of`


CHANCE = "uniform"
WALKER = "shipped:navigation"
TRAINED = (
    Example("the smallest preset", "{command} {subject} --preset {preset} --out runs/{name}"),
    Example(
        "the same without guidance, to compare with",
        "{command} {subject} --preset {preset} --guidance none --out runs/{name}-alone",
    ),
)

PAGES: dict[str, Page] = {
    "train": Page(
        ("out", "env", "teacher", "guidance", "labels", "seed", "labels-from", "resume", "tuning", "track"),
        (
            Example("one agent of the small example", "train billiards --preset quickstart --out runs/one"),
            Example(
                "one agent without guidance", "train billiards --preset quickstart --guidance none --out runs/alone"
            ),
            Example("a walker from 350 labels", "train navigation --preset quickstart --labels 350 --out runs/walker"),
        ),
        (
            *TRAINED,
            Example(
                "50 labels, another seed",
                "{command} {subject} --preset {preset} --labels 50 --seed 1 --out runs/{name}-50",
            ),
        ),
    ),
    "sweep": Page(
        ("out", "env", "teacher", "guidance", "labels", "seeds", "labels-from", "resume", "shard"),
        (
            Example("guided and unguided agents", "sweep billiards --preset quickstart --out runs/quickstart"),
            Example(
                "two label budgets, eight seeds",
                "sweep billiards --preset quickstart --labels 50 100 --seeds 8 --out runs/budgets",
            ),
            Example("the second task", "sweep navigation --preset quickstart --out runs/walks"),
        ),
        (
            *TRAINED,
            Example(
                "two label budgets, four seeds",
                "{command} {subject} --preset {preset} --labels 50 100 --seeds 4 --out runs/{name}-budgets",
            ),
        ),
    ),
    "adapt": Page(
        ("out", "env", "teacher", "labels", "scenario", "guidance", "bound-deg", "labels-from", "judge-by"),
        (
            Example(
                "a walker whose lidar is turned",
                f"adapt {WALKER} --scenario turned_lidar --labels 50 --out policies/turned",
            ),
            Example("the same walker in rooms", f"adapt {WALKER} --scenario rooms --labels 250 --out policies/rooms"),
            Example(
                "a function of observations: the arm's script, its camera turned",
                "adapt cuelearner_envs.arm.scripts:reach --task arm --scenario turned_camera --out policies/reach",
            ),
        ),
        (
            Example(
                "50 labels in a changed world", "adapt {subject}{base}{scenario} --labels 50 --out policies/{name}"
            ),
            Example(
                "what changed in the world, estimated from 100 answers",
                "adapt {subject}{base}{scenario} --guidance relative --labels 500 --out policies/{name}-relative",
            ),
            Example(
                "labels that a person gave on the page",
                "adapt {subject}{base}{scenario} --labels-from labels/{name} --out policies/{name}-person",
            ),
        ),
    ),
    "evaluate": Page(
        ("env", "policy", "scenario", "compare", "episodes", "steps", "guidance", "robot", "labels-from", "out"),
        (
            Example("a trained walker", f"evaluate {WALKER} --episodes 50"),
            Example("the same in a changed world", f"evaluate {WALKER} --scenario corridor --episodes 50"),
            Example(
                "two policies on the same episodes, with the difference",
                f"evaluate --compare {WALKER} uniform --scenario rooms --episodes 50",
            ),
        ),
        (
            Example("on validation episodes", "evaluate {subject}{acting}"),
            Example("in a changed world", "evaluate {subject}{acting}{scenario}"),
            Example("{beside}", "evaluate {subject}{acting}{compared}"),
        ),
    ),
    "report": Page(
        ("out", "metric", "split", "lower-is-better", "by-run", "overwrite"),
        (
            Example("curves and a table of a sweep", "report docs/data/quickstart --out report"),
            Example("another metric", "report docs/data/navigation --metric success --out report-success"),
            Example(
                "of collisions, few are good",
                "report docs/data/navigation --metric collision --lower-is-better --out report-collisions",
            ),
        ),
    ),
    "render": Page(
        ("out", "policy", "scenario", "steps", "episode", "guidance", "question", "film", "overwrite"),
        (
            Example("a film and a still of a walker", f"render {WALKER} --steps 65 --out pictures"),
            Example(
                "the same in a changed world",
                f"render {WALKER} --scenario corridor --steps 65 --out pictures",
            ),
            Example("what a person is asked", f"render {WALKER} --question --out pictures"),
        ),
        (
            Example("a film and a still", "render {subject}{acting} --out pictures"),
            Example("a longer film, another start", "render {subject}{acting} --steps 20 --episode 1 --out pictures"),
            Example("what a person is asked", "render {subject}{acting} --question --out pictures"),
        ),
    ),
    "label": Page(
        ("out", "labels", "guidance", "scenario", "who", "cues", "questions", "again", "open", "port"),
        (
            Example("50 questions about random actions", "label navigation --labels 50 --open"),
            Example(
                "about what a walker does in rooms",
                f"label navigation {WALKER} --scenario rooms --labels 50 --out labels/rooms",
            ),
            Example("show the right action instead", "label billiards --guidance demonstration --out labels/shown"),
        ),
        (
            Example("50 questions, in your browser", "label {subject} --labels 50 --open"),
            Example("under your name", "label {subject} --labels 50 --who ada --out labels/ada"),
            Example("without the questions for practice", "label {subject} --labels 20 --no-practice"),
        ),
    ),
    "labels inspect": Page(
        ("teacher",),
        (
            Example("counts and pace of a file", "labels inspect docs/data/labelling/navigation"),
            Example("and how often the teacher agrees", "labels inspect docs/data/labelling/navigation --teacher"),
            Example("how well two people agree", "labels inspect labels/ada labels/ben"),
        ),
    ),
    "labels merge": Page(
        ("out",),
        (
            Example("two people's labels", "labels merge labels/ada labels/ben --out labels/both.parquet"),
            Example("two sittings'", "labels merge labels/monday labels/tuesday --out labels/week.parquet"),
            Example("a copy of one", "labels merge docs/data/labelling/navigation --out labels/copy.parquet"),
        ),
    ),
    "labels export": Page(
        ("out",),
        (
            Example("for a spreadsheet", "labels export docs/data/labelling/navigation --out labels.csv"),
            Example("as lists", "labels export docs/data/labelling/navigation --out table.parquet"),
            Example("of a run's teacher", "labels export runs/quickstart/relative --out teacher.csv"),
        ),
    ),
    "export": Page(
        ("out", "format", "policy", "guidance", "labels", "seed", "only-correction", "scenario"),
        (
            Example("for a robot without JAX", f"export {WALKER} --format numpy --out exported"),
            Example("for ONNX's runtime", f"export {WALKER} --format onnx --out exported-onnx"),
            Example("for JAX elsewhere", f"export {WALKER} --format stablehlo --out exported-jax"),
        ),
        (
            Example("for a robot without JAX", "export {subject}{exported} --format numpy --out exported"),
            Example("for ONNX's runtime", "export {subject}{exported} --format onnx --out exported-onnx"),
            Example("for JAX elsewhere", "export {subject}{exported} --format stablehlo --out exported-jax"),
        ),
    ),
}


class Subject(NamedTuple):
    """The task or folder named after the command, with the words that examples need."""

    typed: str  # as the user named it
    name: str  # base name for folders in examples
    preset: str = ""  # the smallest preset
    scenario: str = ""  # the first changed world; empty: there is none
    policy: str = ""  # the acting policy, where the usual one is not available


def examples_of(command: str, subject: Subject | None = None) -> list[Example]:
    """Return three command lines for a first page, with the named task or folder in them."""
    page = PAGES[command]
    if subject is None or not page.of_subject:
        return list(page.examples)
    words = {
        "command": command,
        "subject": shlex.quote(subject.typed),
        "name": re.sub(r"[^\w.-]+", "-", subject.name),
        "preset": subject.preset,
        "scenario": f" --scenario {subject.scenario}" if subject.scenario else "",
        "acting": f" --policy {subject.policy}" if subject.policy else "",
        "exported": f" --policy {CHANCE}" if subject.policy else "",
        "base": f" --base.policy {CHANCE}" if subject.policy else "",
        "beside": "few steps" if subject.policy == CHANCE else "beside chance, with the difference",
        "compared": " --steps 2000 --envs 20" if subject.policy == CHANCE else f" --compare {CHANCE}",
    }
    return [Example(*(part.format(**words) for part in example)) for example in page.of_subject]


class Choice(NamedTuple):
    """The names that an option accepts."""

    title: str
    names: tuple[str, ...]


class Option(NamedTuple):
    """An option with its text, as tyro prints it."""

    name: str  # with its metavar
    about: str


def read(text: str) -> tuple[str, str, list[Choice], dict[str, Option], dict[str, int]]:
    """Parse the help that tyro prints without a terminal: boxes of plain characters.

    Returns:
        Usage; the command's purpose; the groups of names; the command's own options by name; the number of options in
        each other group.
    """
    head, *boxes = re.split(r"^ (\S.*?) *\n -{9,} *\n", text, flags=re.MULTILINE)
    usage, about, *groups = head.strip().split("\n\n")
    choices = []
    for title, _, rows in (group.partition(":\n") for group in groups):
        choices.append(Choice(title, tuple(re.findall(r"^  (\S+)", rows, re.MULTILINE))))
    own: dict[str, Option] = {}
    others: dict[str, int] = {}
    for title, box in zip(boxes[::2], boxes[1::2], strict=True):
        found = re.findall(r"^ {2}(\S.*?) *\n((?: {8}.*\n?)*)", box, re.MULTILINE)
        if title not in ("options", "positional arguments"):
            others[title] = sum(name.startswith("--") for name, _ in found)
            continue
        for line, told in found:
            # A short description stands on the line of its option.
            name, _, beside = re.sub(r" {2,}", "\0", line).partition("\0")
            option = Option(_plain(name), _plain(f"{beside} {told}"))
            if "--help" not in name:
                own[_key(option.name)] = option
    return " ".join(usage.split()), " ".join(about.split()), choices, own, others


def _key(name: str) -> str:
    """Return an option's long name without its dashes, or a positional argument's first word."""
    long = re.findall(r"--(?:no-)?([\w-]+)", name)
    return long[-1] if long else name.split(maxsplit=1)[0]


def _plain(text: str) -> str:
    """Return text without defaults that say nothing, and with lists as they are typed."""
    text = re.sub(r"\((?:default: (?:None|False|True)?|required)\)", "", " ".join(text.split()))
    text = text.replace("{None}|", "")
    text = re.sub(r"\[+(\w+) \[\1 \.\.\.\]\]+", r"\1 ...", text)
    return " ".join(text.split())


def command_of(program: str) -> str:
    """Return the command's name at the beginning of a command line without `cuelearner`."""
    return next(name for name in PAGES if f"{program} ".startswith(f"{name} "))


def first_page(text: str, command: str, program: str, subject: Subject | None = None, tasks: Sequence[str] = ()) -> str:
    """Return the first page of a command, made from the whole page that tyro printed.

    Args:
        text: tyro's page.
        command: the command's full name.
        program: the command line so far, for the last line.
        subject: the named task or folder.
        tasks: names of the tasks to choose from, where nothing is named yet.
    """
    usage, about, choices, own, others = read(text)
    usage = re.sub(r"( \[-h\]|(?<= \[OPTIONS\]) \[OPTIONS\])", "", usage)
    wanted = [name for name in PAGES[command].options if name in own]
    positional = [name for name, option in own.items() if not option.name.startswith("-")]
    head = [
        *textwrap.wrap(usage, COLUMNS, subsequent_indent="  "),
        "",
        *textwrap.wrap(about, COLUMNS)[:4],
        "",
        "examples:",
        *lines_of(examples_of(command, subject)),
    ]
    named = {f"--{name}" for name in own} | {"--preset"}
    shown = [choice for choice in choices if any(f"({option}" in choice.title for option in named)]
    shown += [Choice("tasks (or one of your own, as package.module:NAME)", tuple(tasks))] if tasks else []
    foot = ["", *_footer(program, len(own) - len(wanted) - len(positional), others)]
    options = [own[name] for name in [*positional, *wanted]]
    for most in (2, 1):  # lines of a text
        body = [*([""] if shown else []), *(line for choice in shown for line in _chosen(choice, most))]
        body += ["", "options:", *(line for option in options for line in _described(option, most))]
        if len(page := [*head, *body, *foot]) <= LINES:
            break
    return "\n".join(page)


def lines_of(examples: Sequence[Example]) -> Iterator[str]:
    """Yield each example as a comment and a command line, which continues on the next line if it is too long."""
    for about, command in examples:
        yield f"  # {about}"
        lines = textwrap.wrap(f"cuelearner {command}", COLUMNS - 4, break_on_hyphens=False, break_long_words=False)
        yield from ("  " + ("" if place == 0 else "  ") + line + " \\" for place, line in enumerate(lines[:-1]))
        yield "  " + ("" if len(lines) == 1 else "  ") + lines[-1]


def _chosen(choice: Choice, most: int) -> list[str]:
    """Return a group of names in at most so many lines."""
    title = re.sub(r" \((--[\w-]+)(?: of [^;)]*)?", r" (\1", choice.title)
    text = f"{title}: {', '.join(choice.names)}"
    return _cut(textwrap.wrap(text, COLUMNS, subsequent_indent="  ", break_on_hyphens=False), most)


def _described(option: Option, most: int) -> list[str]:
    """Return an option and its text in at most so many lines: of a longer text only the first sentence."""
    name = f"  {option.name}"
    first = f"{name:<{INDENT - 2}}  "
    for text in (option.about, re.split(r"[.;:,]? \(|(?<=[.;:]) ", option.about)[0]):
        lines = textwrap.wrap(first + text, COLUMNS, subsequent_indent=" " * INDENT, break_on_hyphens=False)
        if len(lines) <= most:
            break
    return _cut(lines, most)


def _cut(lines: list[str], most: int) -> list[str]:
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], f"{lines[most - 1][: COLUMNS - 4].rstrip(' ,.;(')} ..."]


def _footer(program: str, more: int, others: dict[str, int]) -> list[str]:
    parts = [
        *([f"{more} more option{'s' * (more > 1)}"] if more > 0 else []),
        *(f"{title} ({n})" for title, n in others.items()),
    ]
    text = f"Everything, with {', '.join(parts)}" if parts else "Everything, with the whole text of each line"
    return textwrap.wrap(f"{text}: {program} {HELP_ALL}", COLUMNS, break_on_hyphens=False)


def subject_of(typed: str, name: str, task: Any, has_usual: bool = True) -> Subject:
    """Return a task, or a folder with policies of a task, as examples name it.

    `has_usual`: whether the policy that acts by default is available.
    """
    preset = "quickstart" if "quickstart" in task.presets else next(iter(task.presets), "")
    policy = "" if has_usual else CHANCE if task.teacher is None else "teacher"
    return Subject(typed, name, preset, next(iter(task.scenarios), ""), policy)
