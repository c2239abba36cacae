"""Find tasks by name: those of the package, of installed packages, and of files that the user names.

A task's code is loaded when the task is asked for. The code of an outside task is loaded only if the user or an
installed package names it, never because a file does.
"""

from __future__ import annotations

import dataclasses
from importlib.metadata import EntryPoint, entry_points
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from cuelearner_jax import plugins
from cuelearner_jax.errors import UserError, suggestion

if TYPE_CHECKING:
    from cuelearner_jax.task import Task

GROUP = "cuelearner.tasks"  # entry points of the form: the task's name = "package.module:name"
BUILT_IN = {
    "arm": "cuelearner_jax.tasks.arm:ARM",
    "billiards": "cuelearner_jax.tasks.billiards:BILLIARDS",
    "gymnasium": "cuelearner_jax.tasks.gymnasium:GYMNASIUM",
    "logs": "cuelearner_jax.tasks.logs:LOGS",
    "navigation": "cuelearner_jax.tasks.navigation:NAVIGATION",
    "brax": "cuelearner_jax.tasks.simulators:BRAX",
    "playground": "cuelearner_jax.tasks.simulators:PLAYGROUND",
    "zoo": "cuelearner_jax.tasks.zoo:ZOO",
}
# Families, named FAMILY:ENVIRONMENT: the function from the environment's name to a task with the family's name. The
# family's own task, which reads its folders, is built in.
FAMILIES: dict[str, str] = {
    "gymnasium": "cuelearner_jax.tasks.gymnasium:task_of",
    "logs": "cuelearner_jax.tasks.logs:task_of",
    "brax": "cuelearner_jax.tasks.simulators:brax_task",
    "playground": "cuelearner_jax.tasks.simulators:playground_task",
    "zoo": "cuelearner_jax.tasks.zoo:task_of",
}

_registered: dict[str, Task] = {}


def names() -> tuple[str, ...]:
    """Return the names of all tasks that can be found by name, without loading any."""
    return tuple(dict.fromkeys([*BUILT_IN, *_installed(), *_registered]))


def find(name: str) -> Task:
    """Return the task called `name`. Raises UserError if it is unknown, or an installed package's does not load."""
    if name in BUILT_IN:
        return resolve_name(BUILT_IN[name])
    if name in _registered:
        return _registered[name]
    if (entry := _installed().get(name)) is None:
        if "/" in name:
            raise UserError(f"{name} is no task, and no folder of a run, a policy or situations: give one of these")
        raise UserError(f"unknown task {name!r}{suggestion(name, names())} (your own: package.module:NAME)")
    return dataclasses.replace(_loaded(entry.value), name=name)


def register(task: Task) -> Task:
    """Make a task known by its name to this process. Raises UserError if another task has the name."""
    before = _registered.get(task.name)
    if task.name in BUILT_IN or task.name in _installed() or (before and before.origin != task.origin):
        raise UserError(f"there is a task {task.name!r} already: give this one another name")
    _registered[task.name] = task
    return task


def resolve(text: str, **options: str) -> Task:
    """Return the task that the user names: by its name, as FAMILY:ENVIRONMENT (`FAMILIES`), or as package.module:name.

    `options` are the family's. A task from outside is registered. The current folder is searched for modules last.
    """
    if ":" not in text:
        return find(text)
    family, _, environment = text.partition(":")
    if family in FAMILIES:
        return dataclasses.replace(resolve_name(FAMILIES[family])(environment, **options), command_name=text)
    task = dataclasses.replace(_loaded(text), origin=text)
    installed = _installed().get(task.name)
    return find(task.name) if installed and installed.value == text else register(task)


def _loaded(reference: str) -> Task:
    from cuelearner_jax.task import Task  # loads JAX, which names alone do not need

    return plugins.load(reference, Task, "a task")


def _installed() -> dict[str, EntryPoint]:
    """Return the entry points of installed packages, except those with the name of a built-in task."""
    return {entry.name: entry for entry in entry_points(group=GROUP) if entry.name not in BUILT_IN}
