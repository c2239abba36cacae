"""`cuelearner teacher train`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic

from cuelearner_jax.cli.parsing import HELP, out, parse, preset_of, summary, task_of
from cuelearner_jax.cli.shared_options import Flag, TaskT
from cuelearner_jax.errors import UserError
from cuelearner_jax.storage.room import free_bytes
from cuelearner_jax.task import shape_of
from cuelearner_jax.teachers import training
from cuelearner_jax.teachers.learned import TeacherConfig


@dataclass(frozen=True)
class TeacherTrain(Generic[TaskT]):
    """Train a teacher from exhaustive tries in parallel."""

    task: TaskT
    out: Path
    """Folder for the teacher."""
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    seed: int = 0
    """Seed."""
    eval_steps: int = 10_000
    """Validation steps at the end (a multiple of 100)."""
    resume: Flag[bool] = False
    """Go on with an interrupted training."""


OPTIONS = {"teacher train": TeacherTrain}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises what `training.train` raises."""
    if not arguments or arguments[0] in HELP:
        print(f"usage: cuelearner teacher train TASK [OPTIONS]\n\n{summary(TeacherTrain)}")
        raise SystemExit(0 if arguments else 2)
    if arguments[0] != "train":
        raise UserError(f"unknown command 'teacher {arguments[0]}': it is cuelearner teacher train TASK")
    task, rest = task_of(arguments[1:], "teacher train", TeacherTrain)
    kind = TeacherTrain[task.config]  # pyright: ignore[reportInvalidTypeArguments]
    _, preset, rest = preset_of(task, rest)
    default = kind(preset.config.task, Path("runs") / f"{task.name}-teacher")
    asked = parse(kind, rest, f"teacher train {task.name}", default)
    training.check(asked.teacher, asked.seed, asked.eval_steps)
    needed, free = training.needed_bytes(asked.teacher, shape_of(task, asked.task)), free_bytes()
    if free and needed > free:
        raise UserError(
            f"the training needs about {needed / 1e9:,.1f} GB, {free / 1e9:.1f} GB are free: lower --teacher.tables, "
            "--teacher.memory or --teacher.search"
        )
    command = shlex.join(["cuelearner", "teacher", *arguments])
    reward = training.train(
        task, asked.task, asked.teacher, asked.out, asked.seed, asked.eval_steps, command, asked.resume
    )
    out.print(f"reward a step over {asked.eval_steps} validation steps: {reward:.4f}; wrote {asked.out}")
