"""On the command line: a folder of recorded situations in place of a task, and cues in words."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

from cuelearner_jax.cli.parsing import taken
from cuelearner_jax.cli.sources import task_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import cues_from
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.tasks import logs, registry
from cuelearner_jax.terminal import console

WORDS = 'words such as "left,right;up,down"'


def task_named(arguments: list[str], command: str, kind: type) -> tuple[Task, list[str]]:
    """Return the task named first, or the task of a folder of situations, and the other arguments.

    Raises UserError if it is not available.
    """
    folder = arguments[0].removeprefix("logs:") if arguments else ""
    recorded = folder and folder not in registry.names() and (Path(folder).exists() or folder != arguments[0])
    if not recorded:
        return task_of(arguments, command, kind)
    rest = arguments[1:]
    low, high = (_numbers(rest, f"--task.{name}") for name in ("low", "high"))
    actions = taken(rest, "--task.actions", "box, directions or choices")[0] or "box"
    cues = taken(rest, "--cues", WORDS)[0] or ""

    def note(words: str) -> None:
        console.print(words.replace("give low and high", "give --task.low and --task.high"))

    return logs.task_of(folder, cues, low, high, actions, note=note), rest


def _numbers(arguments: list[str], option: str) -> list[float] | None:
    """Return the numbers after an option; None if it is not given. Raises UserError for other values."""
    if option not in arguments:
        return None
    behind = arguments[arguments.index(option) + 1 :]
    given = list(itertools.takewhile(lambda word: not word.startswith("--"), behind))
    try:
        return [float(word) for word in given]
    except ValueError:
        raise UserError(f"{option} is {' '.join(given)!r}: give a number for each entry of an action") from None


def with_cues(task: Task, config: Any, cues: str) -> Any:
    """Return a task's configuration with other words for its cues. Raises UserError if the cues are the task's own."""
    fields = {entry.name for entry in dataclasses.fields(config)}
    if not {"cues", "cue_names"} <= fields:
        raise UserError(f"--cues names cues, and {task.name} has its own: leave it out")
    own = {"keys": ()} if "keys" in fields else {}  # the recorded keys belong to the replaced words
    found = dataclasses.replace(config, cues=tuple(",".join(cue.words) for cue in cues_from(cues)), **own)
    shape_of(task, found)  # reports cues that do not fit
    return found
