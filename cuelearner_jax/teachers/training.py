"""Training a teacher on the host: progress, validation, the finished teacher on disk."""

from __future__ import annotations

import json
import math
import shutil
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cuelearner_jax import config as configuration
from cuelearner_jax.config import LARGEST
from cuelearner_jax.errors import NotFinite, UserError
from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import Taught
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.checkpoint import checkpoints
from cuelearner_jax.storage.folders import CONFIG, check_folder, claimed, in_use, prepare_folder
from cuelearner_jax.storage.formats import FORMATS
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.storage.whole import replacing, unreadable
from cuelearner_jax.task import Task
from cuelearner_jax.teachers import stored
from cuelearner_jax.teachers.learned import LearnedTeacher, TeacherConfig, check_config
from cuelearner_jax.teachers.program import TeacherProgram, Trainer, finished, make_program
from cuelearner_jax.terminal import Interrupted, console, interruptible, progress_bars

ROUNDS_A_STRETCH = 50  # in one jitted call
SECONDS_BETWEEN_CHECKPOINTS = 60.0
EVAL_ENVS = 100  # environments that share the validation steps
TRAINING, HISTORY = "training", "history.json"  # kept in the folder until the teacher is finished


def check(config: TeacherConfig, seed: int = 0, eval_steps: int = 1) -> None:
    """Raises UserError for values that cannot work."""
    check_config(config)
    if not 0 <= seed <= LARGEST:
        raise UserError(f"--seed is {seed}: give a number from 0 to {LARGEST}")
    if not 1 <= eval_steps <= LARGEST or eval_steps % min(EVAL_ENVS, eval_steps):
        raise UserError(f"--eval-steps is {eval_steps}: give a positive number, beyond {EVAL_ENVS} a multiple of it")


def needed_bytes(config: TeacherConfig, env: Any) -> int:
    """Memory that a training takes, about [bytes]: what it keeps, and the activations of its widest pass twice."""
    state = jax.eval_shape(Trainer(config).init, env, jax.random.key(0))
    kept = sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    rows = max(config.tables * config.search, config.batch_size * len(config.layers))
    return kept + 2 * 4 * max(config.layers) * rows


def train(
    task: Task,
    world: Any,
    config: TeacherConfig,
    out: Path,
    seed: int,
    eval_steps: int,
    command: str,
    resume: bool = False,
) -> float:
    """Trains a teacher for a world (a task configuration), validates it and writes it.

    Returns:
        Its reward a step over `eval_steps` validation steps.

    Raises:
        UserError: bad configuration, or a folder in use; nothing has been changed then.
        Interrupted: Ctrl-C; everything is saved.
        NotFinite: the training diverged; what its newest checkpoint holds is finite.
    """
    check(config, seed, eval_steps)
    env = task.environment(world)
    if not hasattr(env, "features"):
        raise UserError(f"{task.name} gives a teacher no features to learn from")
    described = {"config": configuration.to_json(config), "task": {"name": task.name, **configuration.to_json(world)}}
    asked = {"format": FORMATS["config"], **described, "seed": seed}
    _check_folder(out, asked, resume)
    with claimed(out):
        _check_folder(out, asked, resume)  # nobody else can change it any more
        if resume and not (out / CONFIG).exists():
            console.print(f"{out}: finished before, left as it is")
            return float(formats.read("teacher", out / stored.ABOUT)["reward"])
        history = _read_history(out / HISTORY)
        prepare_folder(out, asked, clean=False)
        history = _learn(make_program(config), env, config, out, seed, history)
        with checkpoints(out / TRAINING, read_only=True) as saved:
            shapes = jax.eval_shape(make_program(config).init, env, jax.random.key(seed))
            state = saved.restore({"state": shapes})["state"]
        made = finished(config, env, state)
        reward = validate(made, env, eval_steps)
        rows = history[:: max(1, len(history) // 50)]
        about = {
            **described,
            "seed": seed,
            "reward": round(reward, 4),
            "eval_steps": eval_steps,
            **provenance(),
            "command": command,
            "history": {"columns": ["round", "wall_s", "reward", "loss"], "rows": rows},
        }
        stored.save(out, made, about)
        (out / CONFIG).unlink()  # first: a folder that has it is still to be trained
        (out / HISTORY).unlink(missing_ok=True)
        shutil.rmtree(out / TRAINING)
    return reward


def _check_folder(out: Path, asked: dict[str, Any], resume: bool) -> None:
    """Raises UserError unless `out` may be used as asked."""
    if not resume:
        if in_use(out):
            raise UserError(
                f"{out} is not empty: give --resume to go on with an interrupted training, or another --out"
            )
    elif (out / CONFIG).is_file() or not (out / stored.ABOUT).is_file():
        check_folder(out, asked, resume=True, overwrite=False)
    else:
        about = formats.read("teacher", out / stored.ABOUT)
        differing = [name for name in ("config", "task", "seed") if about.get(name) != asked[name]]
        if differing:
            raise UserError(f"{out} holds a teacher of another {', '.join(differing)}: give another --out")


def _read_history(file: Path) -> list[list[float]]:
    """Rows (round, wall_s, reward, loss) of the stretches so far; none where there is no file.

    Raises UserError if it is damaged.
    """
    if not file.exists():
        return []
    try:
        rows = json.loads(file.read_text(encoding="utf-8"))
        sound = all(len(row) == 4 and all(isinstance(number, int | float) for number in row) for row in rows)
    except OSError as error:
        raise unreadable(file, error) from error
    except (ValueError, TypeError, RecursionError):
        rows, sound = [], False
    if not sound or not isinstance(rows, list):
        raise UserError(f"{file} is damaged: restore it, or delete it to go on without what it tells")
    return rows


def _learn(
    program: TeacherProgram, env: Any, config: TeacherConfig, out: Path, seed: int, history: list[list[float]]
) -> list[list[float]]:
    """All rounds, from wherever the folder's newest checkpoint is. Returns (round, wall_s, reward, loss) a stretch."""
    with checkpoints(out / TRAINING) as saved, interruptible() as stopping, progress_bars() as bars:
        state = program.init(env, jax.random.key(seed))
        if saved.latest() is not None:
            state = saved.restore({"state": jax.eval_shape(lambda: state)})["state"]
        history = [row for row in history if row[0] <= int(state.round)]
        before = history[-1][1] if history else 0.0
        started, kept = time.perf_counter(), time.perf_counter()
        bar = bars.add_task("teacher", total=config.rounds, note="", completed=int(state.round))
        while (done := int(state.round)) < config.rounds:
            state, metrics = program.train(env, state, min(ROUNDS_A_STRETCH, config.rounds - done))
            if not metrics["finite"]:
                raise NotFinite(_diverged(out, saved.latest(), int(state.round)))
            reward, loss, now = float(metrics["reward"]), float(metrics["loss"]), time.perf_counter()
            history.append([int(state.round), round(before + now - started, 1), round(reward, 4), round(loss, 5)])
            bars.update(bar, completed=int(state.round), note=f"reward {reward:.3f} loss {loss:.4f}")
            if now - kept > SECONDS_BETWEEN_CHECKPOINTS or stopping.is_set() or int(state.round) >= config.rounds:
                with replacing(out / HISTORY) as file:
                    file.write(json.dumps(history))
                saved.save(int(state.round), {"state": state})
                kept = time.perf_counter()
            if stopping.is_set():
                raise Interrupted(f"stopped at round {int(state.round)}; go on with the same command and --resume")
    return history


def _diverged(out: Path, kept: int | None, done: int) -> str:
    held = "nothing was saved before" if kept is None else f"{out} holds the checkpoint of round {kept}"
    return (
        f"the teacher is no longer finite by round {done:,}, and was not written; {held}: "
        "train with a smaller --teacher.learning-rate and another --out"
    )


def validate(made: LearnedTeacher, env: Any, steps: int) -> float:
    """Reward a step of a teacher's own choices on validation episodes."""
    found = evaluate_policy(env, Taught(made), episodes(), min(EVAL_ENVS, steps), steps)
    return float(np.asarray(found["reward"]))
