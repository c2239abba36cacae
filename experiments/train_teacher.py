"""Train a billiards teacher from exhaustive tries in parallel (minutes on an accelerator).

    python experiments/train_teacher.py billiards --preset easy --task.mirrors --out runs/easy-teacher [--resume]

The shipped teachers were made so (`envs/cuelearner_envs/billiards/teachers`). The first argument names a task, as
package.module:NAME one of your own; its environment must have `features`, and an action's value must be its reward.
A run is labelled by the folder with --task.teacher FOLDER.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
import numpy as np
import tyro
from _teacher_program import TeacherConfig, Trainer

from cuelearner_jax import config as configuration
from cuelearner_jax import teachers
from cuelearner_jax.config import LARGEST
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import Taught
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.storage.folders import CONFIG, check_folder, claimed, in_use, prepare_folder
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.tasks import registry
from cuelearner_jax.teachers import LearnedTeacher
from cuelearner_jax.terminal import Interrupted, interruptible, progress_bars

ROUNDS_A_STRETCH = 50  # in one jitted call
SECONDS_BETWEEN_CHECKPOINTS = 60.0
EVAL_ENVS = 100  # environments that share the validation steps
TRAINING = "training"  # checkpoints, kept in the folder until the teacher is finished
COLUMNS = ("round", "wall_s", "reward", "loss")
TaskT = TypeVar("TaskT")


@dataclass(frozen=True)
class Asked(Generic[TaskT]):
    """Options of the command."""

    task: TaskT
    out: Path
    """Folder for the teacher."""
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    seed: int = 0
    """Seed of the training."""
    eval_steps: int = 10_000
    """Validation steps at the end (a multiple of 100)."""
    resume: bool = False
    """Go on with an interrupted training."""


def train(task: Task, asked: Asked, command: str) -> float:
    """Train a teacher, validate and write it.

    Returns:
        Its reward a step over the validation steps.

    Raises:
        UserError: bad options, or a folder in use; nothing has been changed then.
        Interrupted: Ctrl-C; everything is saved.
        NotFinite: the training diverged; what its newest checkpoint holds is finite.
    """
    configuration.check_part(asked.teacher, "teacher")
    if not 1 <= asked.eval_steps <= LARGEST or asked.eval_steps % min(EVAL_ENVS, asked.eval_steps):
        raise UserError(f"--eval-steps is {asked.eval_steps}: give a positive number, beyond {EVAL_ENVS} a multiple")
    if not hasattr(shape_of(task, asked.task), "features"):
        raise UserError(f"{task.name} gives a teacher no features to learn from")
    out, config, world = asked.out, asked.teacher, configuration.to_json(asked.task)
    described = {"config": configuration.to_json(config), "task": {"name": task.name, **world}, "seed": asked.seed}
    env = task.environment(asked.task)
    if in_use(out) and (out / teachers.ABOUT).exists() and not (out / CONFIG).exists():
        raise UserError(f"{out} holds a finished teacher: give another --out")
    with claimed(out):
        check_folder(out, {"format": formats.FORMATS["config"], **described}, asked.resume, overwrite=False)
        prepare_folder(out, described, clean=False)
        made, history = _learn(env, config, out, asked.seed)
        found = evaluate_policy(env, Taught(made), episodes(), min(EVAL_ENVS, asked.eval_steps), asked.eval_steps)
        reward = float(np.asarray(found["reward"]))
        rows = history[:: max(1, len(history) // 50)]
        about = {
            **described,
            "reward": round(reward, 4),
            "eval_steps": asked.eval_steps,
            **provenance(),
            "command": command,
            "history": {"columns": list(COLUMNS), "rows": [[int(row[0]), *np.round(row[1:], 5)] for row in rows]},
        }
        teachers.save(out, made, about)
        (out / CONFIG).unlink()  # first: a folder that has it is still to be trained
        shutil.rmtree(out / TRAINING)
    return reward


def _learn(env: Any, config: TeacherConfig, out: Path, seed: int) -> tuple[LearnedTeacher, list[list[float]]]:
    """Train all rounds from the folder's newest checkpoint on; return the teacher and `COLUMNS` per stretch."""
    trainer = Trainer(config)
    with Checkpoints(out / TRAINING) as saved, interruptible() as stopping, progress_bars() as bars:
        state = trainer.init(env, jax.random.key(seed))
        history = np.zeros((-(-config.rounds // ROUNDS_A_STRETCH), len(COLUMNS)), np.float32)
        if saved.latest() is not None:
            whole = saved.restore(jax.eval_shape(lambda: {"state": state, "history": history}))
            state, history = whole["state"], np.array(whole["history"])
        before, started, saved_at = history[:, 1].max(), time.perf_counter(), time.perf_counter()
        bar = bars.add_task("teacher", total=config.rounds, note="", completed=int(state.round))
        while (done := int(state.round)) < config.rounds:
            state, metrics = trainer.train(env, state, min(ROUNDS_A_STRETCH, config.rounds - done))
            if not metrics["finite"]:
                kept = saved.latest()
                held = "nothing was saved before" if kept is None else f"{out} holds the checkpoint of round {kept}"
                raise NotFinite(
                    f"the teacher is no longer finite by round {int(state.round):,}, and was not written; {held}: "
                    "train with a smaller --teacher.learning-rate and another --out"
                )
            reward, loss, now = float(metrics["reward"]), float(metrics["loss"]), time.perf_counter()
            history[done // ROUNDS_A_STRETCH] = int(state.round), before + now - started, reward, loss
            bars.update(bar, completed=int(state.round), note=f"reward {reward:.3f} loss {loss:.4f}")
            if now - saved_at > SECONDS_BETWEEN_CHECKPOINTS or stopping.is_set() or int(state.round) >= config.rounds:
                saved.save(int(state.round), {"state": state, "history": history})
                saved_at = time.perf_counter()
            if stopping.is_set():
                raise Interrupted(f"stopped at round {int(state.round)}; go on with the same command and --resume")
    # It aims perfectly and has no habit.
    return LearnedTeacher(env, state.average, 0.0, 0.0, config.layers, config.directions), history.tolist()


def main(arguments: list[str] | None = None) -> int:
    """Read the arguments and train; return the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    named, rest = (arguments[:1], arguments[1:]) if arguments and arguments[0][0] != "-" else ([], arguments)
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--preset")
    preset, rest = parser.parse_known_args(rest)
    try:
        task = registry.resolve(*(named or ["billiards"]))
        if preset.preset is not None and preset.preset not in task.presets:
            raise UserError(f"unknown --preset {preset.preset!r}: choose one of {', '.join(task.presets)}")
        world = task.presets[preset.preset or next(iter(task.presets))].config.task
        default = Asked(world, Path("runs") / f"{task.name}-teacher")
        kind: Any = Asked[task.config]  # pyright: ignore[reportInvalidTypeArguments]
        asked = tyro.cli(kind, args=rest, default=default, prog=Path(__file__).name, description=__doc__)
        reward = train(task, asked, shlex.join(["python", f"experiments/{Path(__file__).name}", *arguments]))
        print(f"reward a step over {asked.eval_steps} validation steps: {reward:.4f}; wrote {asked.out}")
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (Interrupted, NotFinite) as error:
        print(error, file=sys.stderr)
        return error.status
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
