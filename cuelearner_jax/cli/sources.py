"""What the first words of a command line name: a task and its preset, a run folder, a policy or its code."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from cuelearner_jax import plugins
from cuelearner_jax.adaptation import changes
from cuelearner_jax.cli.pages import HELP, HELP_ALL
from cuelearner_jax.cli.parsing import explain, taken
from cuelearner_jax.environment import actions_of, check_layout
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.policies import policy_of, teaching
from cuelearner_jax.policies.foreign import FILES
from cuelearner_jax.run_config import PARTS
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage import policy_folders
from cuelearner_jax.task import PAPER, Preset, Task, shape_of
from cuelearner_jax.tasks import registry, shipped

TASK_OPTIONS = ("--task", "--env")  # two names of one option


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


def _task_option(arguments: list[str]) -> tuple[str | None, list[str]]:
    choices = f"{', '.join(registry.names())}, or package.module:name"
    found, rest = [], arguments
    for option in TASK_OPTIONS:
        given, rest = taken(rest, option, choices)
        if given is not None:
            found.append(_environment(given) if option == "--env" else given)
    if len(found) > 1:
        raise UserError(f"the task is named twice, {found[0]!r} and {found[1]!r}: name it once")
    return (found or [None])[0], rest


def _environment(given: str) -> str:
    """Return the name of a task; code that is no task is an environment of Gymnasium's kind."""
    is_outside = plugins.REFERENCE.fullmatch(given) and given.partition(":")[0] not in registry.FAMILIES
    if is_outside and not isinstance(plugins.load(given, object, "an environment"), Task):
        return f"gymnasium:{given}"
    return given


def _taught(task: Task, reference: str | None) -> Task:
    """Return the task with the teacher that `package.module:NAME` leads to: a teacher, or a policy used as one.

    Raises UserError if there is none.
    """
    if reference is None:
        return task
    code = plugins.load(reference, object, "a teacher")
    return dataclasses.replace(task, teacher=lambda config, env: teaching(code, actions_of(env)), brief_teacher=None)


def is_code(named: str) -> bool:
    """Return whether a word names a policy that is code: package.module:NAME, or a file of another library."""
    if shipped.is_shipped(named) or Path(named).is_dir():
        return False
    return named.endswith(FILES) or ".py:" in named or bool(plugins.REFERENCE.fullmatch(named))


def code_of(reference: str) -> Any:
    """Return the policy of `package.module:NAME` or of a file in ONNX. Raises UserError if there is none."""
    return policy_of(reference if reference.endswith(FILES) else plugins.load(reference, object, "a policy"))


def _of_folder(folder: Path, known: Task | None, code: Any, changed: Any) -> PolicySource:
    """Open a run or policy folder, for a family of tasks in the environment named beside it.

    Raises UserError for another kind of folder, another task than named, or other observations or actions.
    """
    source = PolicySource.of_folder(folder, registry.find, code, changed)
    if known is not None and known.name != source.task.name:
        what = "a run" if source.grid else "a policy"
        raise UserError(f"{folder} is {what} of {source.task.name}, not of {known.name}: leave out --task")
    if known is not None and known.named:
        before = shape_of(known, source.config.task)
        check_layout(f"{folder}", before.observation, actions_of(before), shape_of(known, known.plain()))
        if known.named == f"{known.name}:{getattr(source.config.task, 'environment', '')}":
            return dataclasses.replace(source, task=known)  # with the folder's settings of this environment
        world = dataclasses.replace(source.config, task=known.plain())
        source = dataclasses.replace(source, task=known, config=world)
    return source
