"""Label files compared: with what a task's teacher would have answered, and two people's on the same questions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax import config as configuration
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.labelling.programs import Agreement, agreement, as_teacher, keys_of, lived
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.label_files import LabelFile
from cuelearner_jax.task import Task


def form_of(file: LabelFile) -> AnswerForm | None:
    """The form of a file's answers; None: of a kind of guidance that is not known here."""
    forms = {kind.form.name: kind.form for kind in guidances.kinds() if kind.form is not None}
    return forms.get(file.answers)


def checked(path: Path) -> LabelFile:
    """The labels of a file, as training would take them. Raises UserError if there are none, or one makes no sense."""
    file = label_files.read(path)
    external_labels.check_file(file, None, form_of(file), str(path))
    return file


def world_of(task: Task, file: LabelFile) -> Any:
    """The configuration in which a file's labels were given. Raises UserError if it is not this task's."""
    values = {name: value for name, value in file.task.items() if name not in ("name", "from")}
    try:
        return configuration.from_json(task.config, values)
    except TypeError as error:
        raise UserError(
            f"the file's world is none of {task.name} ({error}): it was written by another version"
        ) from error


def with_teacher(
    task: Task,
    file: LabelFile,
    rows: list[dict[str, Any]],
    scalars: Scalars,
    tell: Callable[[str], None] = lambda words: None,
) -> Agreement:
    """How well a page's labels agree with the answers of the task's teacher, who makes no faults.

    The situations of all `rows` (`label_files.history`) are lived through anew. Raises UserError if the task has no
    teacher, or the situations cannot be had again.
    """
    form = form_of(file)
    if form is None or file.people is None or file.session is None:
        raise UserError("a teacher looks at situations, and this file's cannot be had again: it is no page's own file")
    config, task = world_of(task, file), task.on(str(file.session.get("robot", "")).partition(" ")[0] or None)
    tell(f"asking the teacher of {task.name} about {len(rows)} questions")
    env = task.environment(config)
    teacher = task.make_teacher(config, env)
    items = {row["item"]: (np.asarray(row["obs"], np.float32), np.asarray(row["action"], np.float32)) for row in rows}
    situations = list(lived(env, keys_of(file.session["seed"]), [items[number] for number in range(len(items))]))
    if len(situations) <= len(items):
        raise UserError("the file's situations come out otherwise with this program: use the one that wrote it")
    told = scalars if file.eps is None else dataclasses.replace(scalars, eps_deg=file.eps)

    @jax.jit
    def one(env: Environment, teacher: Any, state: Any, obs: jax.Array, action: jax.Array) -> jax.Array:
        return as_teacher(form, env, told, teacher, state, obs, action)

    asked = [(*situations[item], jnp.asarray(items[item][1])) for item in file.people.item]
    theirs = np.stack([np.asarray(one(env, teacher, *question)) for question in asked])
    return agreement(form, env, np.asarray(file.labels.answer), theirs)


def between(one: LabelFile, other: LabelFile, env: Any) -> Agreement:
    """How well two files agree on the questions that both answered: the same observation and action.

    Raises UserError if their answers are of two forms, spaces or strengths.
    """
    form = form_of(one)
    if form is None or (one.answers, one.space, one.eps) != (other.answers, other.space, other.eps):
        raise UserError(f"the files hold {_called(one)} and {_called(other)} answers: give two of one form")
    theirs = _by_question(other)
    mine = _by_question(one)
    both = [question for question in mine if question in theirs]
    width = form.width(one.space)
    pairs = np.array([(mine[question], theirs[question]) for question in both], np.float32).reshape(-1, 2, width)
    return agreement(form, env, pairs[:, 0], pairs[:, 1])


def _called(file: LabelFile) -> str:
    return file.answers if file.eps is None else f"{file.answers} ({file.eps:g} {file.space.unit})"


def _by_question(file: LabelFile) -> dict[bytes, np.ndarray]:
    return dict(_questions(file))


def _questions(file: LabelFile) -> Iterator[tuple[bytes, np.ndarray]]:
    """What was asked, observation and action, and what was said, label after label."""
    columns = (file.labels.obs, file.labels.action, file.labels.answer)
    for *asked, answer in zip(*(np.asarray(column) for column in columns), strict=True):
        yield b"".join(part.tobytes() for part in asked), answer


def merged(files: Iterable[LabelFile]) -> tuple[LabelFile, int]:
    """One set of labels of several files' sets, one after the other, and how many were left out as they were there.

    A label is there already if one of an earlier file has its observation, action and answer, and the person and the
    time where both tell them.

    Raises UserError if they differ in task, world, form or strength, or a file holds several sets.
    """
    files = list(files)
    first = files[0]
    for file in files:
        if len(np.unique(file.seeds)) > 1:
            raise UserError("a file holds the labels of several seeds, which belong apart: merge files of one set each")
        for name in ("task", "answers", "space", "eps"):
            if getattr(file, name) != getattr(first, name):
                raise UserError(
                    f"the files differ in {name} ({getattr(first, name)}, {getattr(file, name)}): merge alike ones"
                )
    if len({(file.labels.obs.shape[1], file.labels.action.shape[1]) for file in files}) > 1:
        raise UserError("the files' observations differ in size: merge files of one world")
    new = _new(files)
    files = [_rows(file, kept) for file, kept in zip(files, new, strict=True)]
    labels = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(file.labels for file in files))
    told = [file.people for file in files if file.people is not None]
    people = None
    if len(told) == len(files):
        parts = [np.concatenate(columns) for columns in zip(*told, strict=True)]
        people = label_files.People(np.arange(len(parts[0])), *parts[1:])
    seeds = np.zeros(len(labels.valid), np.int64)
    left_out = sum(int((~kept).sum()) for kept in new)
    return LabelFile(first.task, first.answers, first.space, first.eps, seeds, labels, people), left_out


def _new(files: list[LabelFile]) -> list[np.ndarray]:
    """Of each file, which of its labels no file before it has, (labels,)."""
    there: dict[bytes, set[Any]] = {}
    found = []
    for file in files:
        keys = [question + answer.tobytes() for question, answer in _questions(file)]
        people = file.people
        by = [None] * len(keys) if people is None else list(zip(people.who.tolist(), people.when.tolist(), strict=True))
        kept = []
        for key, who in zip(keys, by, strict=True):
            before = there.get(key, set())
            kept.append(not (before and (who is None or who in before or None in before)))
        for key, who in zip(keys, by, strict=True):
            there.setdefault(key, set()).add(who)
        found.append(np.array(kept, bool))
    return found


def _rows(file: LabelFile, kept: np.ndarray) -> LabelFile:
    """Some of a file's labels."""
    people = None if file.people is None else label_files.People(*(column[kept] for column in file.people))
    labels = jax.tree.map(lambda leaf: np.asarray(leaf)[kept], file.labels)
    return file._replace(seeds=file.seeds[kept], labels=labels, people=people)
