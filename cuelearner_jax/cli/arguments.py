"""Reading the command line: the task, preset or run named first, then options as a dataclass; refusals in one line."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path
from typing import Any

import tyro

from cuelearner_jax.errors import UserError, closest
from cuelearner_jax.runs import grid as runs
from cuelearner_jax.runs import trained as play
from cuelearner_jax.tasks.registry import TASKS, Task

ABOUT = {
    "train": "Train one seed under one kind of guidance.",
    "sweep": "Train seeds x label budgets x kinds of guidance in one process.",
    "evaluate": "Validate a run's newest checkpoints, or a task's teacher, heuristic or chance; in any changed world.",
    "report": "Curves and tables with intervals from recorded results.",
    "render": "A still and a film of a policy at work.",
    "teacher": "teacher train: train a teacher from exhaustive tries in parallel.",
    "bench": "Throughput, memory a seed and share of peak of this machine, beside known machines.",
    "locomotion": "locomotion train, locomotion evaluate: the quadruped's walking policy.",
}


def parse(kind: Any, arguments: list[str], program: str, default: Any = None) -> Any:
    """Arguments as a dataclass. Raises UserError with tyro's message in one line."""
    errors = io.StringIO()
    keywords = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(kind, args=arguments, prog=f"cuelearner {program}", **keywords)
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [re.sub(r"^[│╭╰─\s]+|[│╮╯─\s]+$", "", line) for line in errors.getvalue().splitlines()]
        told = " ".join(line for line in lines[1:] if line)
        told = re.split(r"For full helptext|Argument helptext", told)[0].strip()
        told = told.replace("Perhaps you meant:", "; perhaps you meant")
        told = re.sub(r"\s+", " ", told).replace(" ;", ";")[:400]
        raise UserError(f"{told}; see cuelearner {program} --help") from None


def task_of(arguments: list[str], command: str) -> tuple[Task, list[str]]:
    """The task named first."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"usage: cuelearner {command} TASK [--preset NAME] [OPTIONS]\n\n{ABOUT[command.split(maxsplit=1)[0]]}\n")
        for task in TASKS.values():
            print(f"task {task.name}, presets:")
            for name, preset in task.presets.items():
                print(f"  {name:<12}{preset.about}")
        print(f"\noptions and their defaults: cuelearner {command} TASK --help")
        raise SystemExit(0 if arguments else 2)
    name = arguments[0]
    if name not in TASKS:
        raise UserError(f"unknown task {name!r}{closest(name, TASKS)}")
    return TASKS[name], arguments[1:]


def preset_of(task: Task, arguments: list[str]) -> tuple[str, list[str]]:
    """The preset's name, taken out of the arguments; `paper` if none is given."""
    rest, name = list(arguments), "paper"
    for index, argument in enumerate(arguments):
        if argument == "--preset" or argument.startswith("--preset="):
            if argument == "--preset" and index + 1 == len(arguments):
                raise UserError(f"--preset needs a name: choose one of {', '.join(task.presets)}")
            name = argument.partition("=")[2] if "=" in argument else arguments[index + 1]
            del rest[index : index + (1 if "=" in argument else 2)]
            break
    if name not in task.presets:
        raise UserError(f"unknown preset {name!r}{closest(name, task.presets)}")
    return name, rest


def subject_of(arguments: list[str], command: str) -> tuple[play.PolicySource, list[str]]:
    """The run folder or task named first."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"usage: cuelearner {command} RUN_FOLDER|TASK [OPTIONS]\n\n{ABOUT[command]}\n")
        for task in TASKS.values():
            for name, robot in task.robots.items():
                print(f"other bodies of {task.name}:\n  --robot {name:<10}{robot.about}\n")
        print(f"options and their defaults: cuelearner {command} {next(iter(TASKS))} --help")
        raise SystemExit(0 if arguments else 2)
    name, rest = arguments[0], arguments[1:]
    if name in TASKS and not Path(name, "config.json").exists():
        task = TASKS[name]
        preset, rest = preset_of(task, rest)
        return play.PolicySource(task, task.presets[preset].config, None, Path(name)), rest
    if not Path(name).exists():
        raise UserError(f"{name!r} is neither a run folder nor a task ({', '.join(TASKS)})")
    task, config, grid = runs.load(Path(name), TASKS)
    return play.PolicySource(task, config, grid, Path(name)), rest
