"""Compare and merge label files: with a task's teacher, with each other, and several into one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cuelearner_jax.config import Scalars, from_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback import external_labels
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.labelling.learner import AnswerAgreement, agreement, as_teacher
from cuelearner_jax.labelling.plan import keys_of, replay
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.label_files import LabelFile
from cuelearner_jax.task import Task


def form_of(file: LabelFile) -> AnswerForm | None:
    """Return the form of a label file's answers; None where no known kind of guidance has this form."""
    forms = {kind.form.name: kind.form for kind in guidances.guides().values() if kind.form is not None}
    return forms.get(file.answers)


def read_checked(path: Path) -> LabelFile:
    """Read a label file and check it as training does. Raises UserError for an empty or invalid file."""
    file = label_files.read(path)
    external_labels.check_file(file, None, form_of(file), str(path))
    return file


def with_teacher(
    task: Task, file: LabelFile, rows: list[dict[str, Any]], scalars: Scalars, tell: Callable[[str], None]
) -> AnswerAgreement:
    """Return how well a page's labels agree with the answers of the task's teacher, simulated without mistakes.

    The situations of all `rows` (`label_files.history`) are replayed.
    """
    form = form_of(file)
    if form is None or file.people is None or file.session is None:
        raise UserError("the teacher cannot be asked about this file: give a file that `cuelearner label` wrote")
    if task.teacher is None:
        raise UserError(f"{task.name} has no teacher to ask: give --task a task of your own that has one")
    config = from_json(task.config, file.task)
    task = task.on(str(file.session.get("robot", "")).partition(" ")[0] or None)
    tell(f"asking the teacher of {task.name} about {len(rows)} questions")
    env = task.environment(config)
    teacher = task.make_teacher(config, env)
    items = {row["item"]: (np.asarray(row["obs"], np.float32), np.asarray(row["action"], np.float32)) for row in rows}
    situations = list(replay(env, keys_of(file.session["seed"]), [items[number] for number in range(len(items))]))
    if len(situations) <= len(items):
        raise UserError("replaying gives other observations than the file: use the version of cuelearner that wrote it")
    scalars = scalars if file.eps is None else dataclasses.replace(scalars, eps_deg=file.eps)
    one = jax.jit(lambda env, teacher, *question: as_teacher(form, env, scalars, teacher, *question))
    answers = np.asarray(file.labels.answer)
    about = zip([(situations[item], items[item][1]) for item in file.people.item], answers, strict=True)
    theirs = np.stack([one(env, teacher, guide.env, guide.obs, action, answer) for (guide, action), answer in about])
    return agreement(form, file.space, answers, theirs)


def between(one: LabelFile, other: LabelFile) -> AnswerAgreement:
    """Return how well two files agree: each answer with each of the other file's to an equal observation and action."""
    form = form_of(one)
    if form is None or (one.answers, one.space.size, one.eps) != (other.answers, other.space.size, other.eps):
        kinds = [
            file.answers + ("" if file.eps is None else f" ({file.eps:g} {file.space.unit})") for file in (one, other)
        ]
        raise UserError(f"the files hold {' and '.join(kinds)} answers: give two of one form")
    mine, others = (zip(_questions(file), np.asarray(file.labels.answer), strict=True) for file in (one, other))
    theirs: dict[bytes, list[np.ndarray]] = {}
    for question, answer in others:
        theirs.setdefault(question, []).append(answer)
    pairs = [(answer, their) for question, answer in mine for their in theirs.get(question, ())]
    both = np.array(pairs, np.float32).reshape(-1, 2, form.width(one.space))
    return agreement(form, one.space, both[:, 0], both[:, 1])


def _questions(file: LabelFile) -> list[bytes]:
    """Return each label's question, as the bytes of its observation and action, and of the second action of a pair."""
    form, labels = form_of(file), file.labels
    second = np.asarray(labels.answer)[:, 1:] if form and form.second else np.zeros((len(labels.obs), 0))
    return [row.tobytes() for row in np.concatenate([labels.obs, labels.action, second], -1, dtype=np.float32)]


def merge(files: Iterable[LabelFile], labels_hold: Iterable[str] = ()) -> tuple[LabelFile, int]:
    """Concatenate the labels of several files; return the merged file and the number of duplicates left out.

    A label is a duplicate if an earlier file has a label of equal observation, action and answer, and of equal person
    and time where both files record them. Raises UserError if task, form, strength or world differ (`labels_hold` may).
    """
    files, earlier, nameless, fresh = list(files), set(), set(), []
    first, everyone = files[0], all(file.people is not None for file in files)
    for file in files:
        if len(np.unique(file.seeds)) > 1:
            raise UserError("a file holds the labels of several seeds: merge files of one seed each")
        own, other = ({**of.space.to_json(), **of.task, "answers": of.answers, "eps": of.eps} for of in (first, file))
        apart = {"path"} if "digest" in first.task else {}  # a recording, which its digest tells, may lie elsewhere
        for name in own | other:
            if name not in {*apart, *labels_hold} and (before := own.get(name)) != (now := other.get(name)):
                raise UserError(f"the files differ in {name} ({before}, {now}): merge only files that agree in it")
        if file.labels.obs.shape[1] != first.labels.obs.shape[1]:
            raise UserError("the files' observations differ in size: merge files of one world")
        people = (file.people.who.tolist(), file.people.when.tolist()) if file.people else ()
        keys = list(zip(_questions(file), map(bytes, np.asarray(file.labels.answer)), *people, strict=True))
        fresh += [key not in earlier and key[:2] not in nameless for key in keys]
        earlier.update(keys, (key[:2] for key in keys))
        nameless.update(() if people else keys)
    mask = np.array(fresh, bool)
    labels = jax.tree.map(lambda *leaves: np.concatenate(leaves)[mask], *(file.labels for file in files))
    people = None
    if everyone:
        columns = [np.concatenate(each)[mask] for each in zip(*(file.people or () for file in files), strict=True)]
        people = label_files.People(np.arange(len(labels.valid)), *columns[1:])
    seeds = np.zeros(len(labels.valid), np.int64)
    return LabelFile(first.task, first.answers, first.space, first.eps, seeds, labels, people), int((~mask).sum())
