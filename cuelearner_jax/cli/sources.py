"""What a command line names: a task and its preset, a folder with policies, a policy's code, recorded situations."""

from __future__ import annotations

import dataclasses
from argparse import Namespace
from pathlib import Path
from typing import Any

from cuelearner_jax import plugins
from cuelearner_jax.adaptation import changes
from cuelearner_jax.api.adaptation import world_of
from cuelearner_jax.api.labels import labels_from_file
from cuelearner_jax.cli.options import about, look_ahead_of, parse
from cuelearner_jax.environment import actions_of, check_layout
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.policies import FILES, policy_of, teaching
from cuelearner_jax.run_config import PARTS
from cuelearner_jax.runs.policy_sources import PolicySource
from cuelearner_jax.spaces import cues_from
from cuelearner_jax.storage import policy_folders
from cuelearner_jax.task import PAPER, Preset, Task, shape_of
from cuelearner_jax.tasks import logs, registry, shipped
from cuelearner_jax.terminal import console


def task_of(ahead: Namespace) -> Task:
    """Return the task named first, or by --task or --env; --teacher makes code its teacher. Raises UserError."""
    task = _task_by_option(ahead)
    if task is not None and ahead.words:
        raise UserError(f"the task is named twice, {ahead.words[0]!r} and {ahead.env!r}: name it once")
    return _with_teacher(task or _resolved(ahead.words[0], ahead), ahead.teacher)


def recorded_or_task(ahead: Namespace) -> Task:
    """Return the task of a folder of recorded situations that is named first, or `task_of`."""
    folder = ahead.words[0].removeprefix("logs:") if ahead.words else ""
    if not folder or folder in registry.names() or not (Path(folder).exists() or folder != ahead.words[0]):
        return task_of(ahead)
    low, high, actions = (getattr(ahead, f"task.{name}") for name in ("low", "high", "actions"))
    note = lambda words: console.print(words.replace("give low and high", "give --task.low and --task.high"))  # noqa: E731
    return logs.task_of(folder, ahead.cues or "", low, high, actions or "box", note=note)


def with_cues(task: Task, config: Any, cues: str) -> Any:
    """Return a task's configuration with other words for its cues. Raises UserError if the cues are the task's own."""
    fields = {entry.name for entry in dataclasses.fields(config)}
    if not {"cues", "cue_names"} <= fields:
        raise UserError(f"--cues names cues, and {task.name} has its own: leave it out")
    own = {"keys": ()} if "keys" in fields else {}  # the recorded keys belong to the replaced words
    own_cues = cues_from(cues, config.cue_names if "=" in cues else ())
    result = dataclasses.replace(config, cues=tuple(",".join(cue.words) for cue in own_cues), **own)
    shape_of(task, result)  # reports cues that do not fit
    return result


def preset_of(task: Task, name: str | None, default: str = PAPER) -> tuple[str, Preset]:
    """Return the preset of a name (default: `default` or the first). Raises UserError if unknown."""
    if not task.presets and task.name in registry.FAMILIES:
        raise UserError(f"{task.name} is a family of tasks: name one of its environments, as {task.name}:NAME")
    if not task.presets:
        raise UserError(f"{task.name} has no preset to start from: give its Task one")
    name = task.first_preset(default) if name is None else name
    if name not in task.presets:
        raise UserError(f"unknown preset {name!r}{suggestion(name, task.presets)}")
    return name, task.presets[name]


def source_of(ahead: Namespace, is_policy: bool = False) -> PolicySource:
    """Return the run folder, policy folder or task named first; or code, a policy of the user's own in a task.

    --task, or --env, makes an outside task known, and a library's environment the world of a folder. --teacher makes
    code its teacher. --agent and --arbiter name a run's outside parts; --base and --changes a policy's code. Code
    without a task acts in the situations of --labels-from; without code their proposed actions are the policy.
    `is_policy`: code without a task is a policy, not a task.
    """
    word, task, code = ahead.words[0] if ahead.words else None, _task_by_option(ahead), None
    if word is task is None and ahead.labels_from is not None:
        task = _recording_task("a recording's proposed actions", ahead.labels_from)
    base = None if ahead.base is None else code_of(ahead.base)
    for name, table in PARTS.items():
        if (part := getattr(ahead, name)) is not None:
            plugins.resolve(table, part, name)
    if word is not None:
        folder = shipped.folder_of(word)
        holds = (folder / "config.json").exists() or policy_folders.is_one(folder)
        if holds or (folder.is_dir() and word not in registry.names()):
            source = source_in(folder, task, base, ahead.changes)
            return dataclasses.replace(source, task=_with_teacher(source.task, ahead.teacher))
        if is_code(word) and (task is not None or is_policy or ahead.labels_from is not None):
            task = task or _recording_task(word, ahead.labels_from)
            code = code_of(word)
        elif task is not None:
            raise UserError(f"{word!r} is no run folder of the task {task.name}: give one, or code as module:NAME")
        elif ":" not in word and word not in registry.names():
            raise UserError(
                f"{word!r} is no run or policy folder, no task ({', '.join(registry.names())}) "
                f"and no shipped agent ({', '.join(shipped.names())})"
            )
    task = task or _resolved(str(word), ahead)
    if base is not None:
        raise UserError("--base names the code in a policy folder: give that folder, or leave it out")
    _, preset = preset_of(task, ahead.preset)
    return PolicySource(_with_teacher(task, ahead.teacher), preset.config, None, Path(task.name), code=code)


def source_in(folder: Path, task: Task | None, code: Any, path: str | None) -> PolicySource:
    """Return the policies of a run or policy folder, for a family of tasks in the environment named beside it.

    `code`, `path`: code of a policy folder (an object, and package.module:NAME).
    """

    def find(name: str) -> Task:
        return task if task is not None and task.name == name and not task.command_name else registry.find(name)

    source = PolicySource.of_folder(folder, find, code, None if path is None else changes.load(path))
    if task is not None and task.name != source.task.name:
        what = "a run" if source.grid else "a policy"
        raise UserError(f"{folder} is {what} of {source.task.name}, not of {task.name}: give one of {task.name}")
    if task is None or not task.command_name:
        return source
    before = shape_of(task, source.config.task)
    check_layout(f"{folder}", before.observation, actions_of(before), shape_of(task, task.plain()))
    if getattr(task.plain(), "environment", None) == getattr(source.config.task, "environment", ""):
        return dataclasses.replace(source, task=task)  # with the folder's settings of this environment
    return dataclasses.replace(source, task=task, config=dataclasses.replace(source.config, task=task.plain()))


def source_and_options(arguments: list[str], command: str, kind: Any, more: str = "") -> tuple[PolicySource, Any]:
    """Return the policies' source, with the chosen robot, and the options of a command about finished policies.

    `more` is added to the help's text. Raises UserError for choices that do not exist.
    """
    ahead = look_ahead_of(arguments, command, kind)
    source = source_of(ahead)
    world = source.config.task
    if ahead.scenario is not None:
        world = source.task.scenario(ahead.scenario).apply(world)
    default = kind(task=world, policy=source.default_policy)
    options = parse(kind, arguments, command, default, about(kind, source.task, policies=True) + more)
    return source.on(options.robot), options


def _task_by_option(ahead: Namespace) -> Task | None:
    """Return the task of --env, or --task, where code that is no task is an environment of Gymnasium's kind."""
    if (word := ahead.env) is None:
        return None
    is_outside = plugins.REFERENCE.fullmatch(word) and word.partition(":")[0] not in registry.FAMILIES
    if is_outside and not isinstance(plugins.load(word, object, "an environment"), Task):
        word = f"gymnasium:{word}"
    return _resolved(word, ahead)


def _resolved(word: str, ahead: Namespace) -> Task:
    """Return the task of a name. The layout of Gymnasium's environments may depend on --task.arguments."""
    text = getattr(ahead, "task.arguments") if word.startswith("gymnasium:") else None
    return registry.resolve(word) if text is None else registry.resolve(word, arguments=text)


def _recording_task(subject: str, path: str | None) -> Task:
    """Return the situations of a label file as a task. Raises UserError unless its labels are about a recording.

    `subject`: the code that acts in them.
    """
    labels = None if path is None else labels_from_file(Path(path))
    if labels is None or labels.task.get("name") != logs.NAME:
        why = "" if path is None else f", since {path} does not hold labels of a recording"
        advice = "give one, for instance --task navigation or --env gymnasium:NAME"
        raise UserError(f"{subject} needs a task to act in{why}: {advice}")
    return world_of(labels).task


def _with_teacher(task: Task, reference: str | None) -> Task:
    """Return the task with the teacher that `package.module:NAME` leads to: a teacher, or a policy used as one."""
    if reference is None:
        return task
    code = plugins.load(reference, object, "a teacher")
    files = lambda config: {**task.files(config), "teacher": reference}  # noqa: E731
    teacher = lambda config, env: teaching(code, actions_of(env))  # noqa: E731
    return dataclasses.replace(task, teacher=teacher, brief_teacher=None, files=files)


def is_code(word: str) -> bool:
    """Return whether a word names a policy that is code: package.module:NAME, or a file of another library."""
    if shipped.is_shipped(word) or Path(word).is_dir():
        return False
    return word.endswith(FILES) or ".py:" in word or bool(plugins.REFERENCE.fullmatch(word))


def code_of(reference: str) -> Any:
    """Return the policy of `package.module:NAME` or of a file in ONNX. Raises UserError if there is none."""
    return policy_of(reference if reference.endswith(FILES) else plugins.load(reference, object, "a policy"))
