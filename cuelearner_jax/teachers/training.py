"""Training a teacher on the host: progress, validation, the finished teacher on disk."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cuelearner_jax import config as configuration
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import Taught
from cuelearner_jax.records.checkpoint import checkpoints
from cuelearner_jax.records.folders import check_folder, in_use, prepare_folder
from cuelearner_jax.records.formats import FORMATS
from cuelearner_jax.records.provenance import provenance
from cuelearner_jax.task import Task
from cuelearner_jax.teachers import stored
from cuelearner_jax.teachers.learned import LearnedTeacher, TeacherConfig
from cuelearner_jax.teachers.program import TeacherProgram, finished, make_program
from cuelearner_jax.terminal import Interrupted, interruptible, progress_bars

ROUNDS_A_STRETCH = 50  # in one jitted call
SECONDS_BETWEEN_CHECKPOINTS = 60.0
TRAINING, HISTORY = "training", "history.json"  # kept in the folder until the teacher is finished


def check(config: TeacherConfig) -> None:
    """Raises UserError for values that cannot work."""
    for name in ("tables", "search", "directions", "memory", "updates", "batch_size", "rounds"):
        if getattr(config, name) < 1:
            raise UserError(f"teacher.{name} is {getattr(config, name)}: give a positive number")
    if config.tries < 4:
        raise UserError(
            f"teacher.tries is {config.tries}: give at least 4 (the best, a promising one, two uniform ones)"
        )
    if not config.layers:
        raise UserError("teacher.layers: give at least one layer")


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
    """
    check(config)
    env = task.environment(world)
    if not hasattr(env, "features"):
        raise UserError(f"{task.name} gives a teacher no features to learn from")
    described = {"config": configuration.to_json(config), "task": {"name": task.name, **configuration.to_json(world)}}
    asked = {"format": FORMATS["config"], **described, "seed": seed}
    if not resume and in_use(out):
        raise UserError(f"{out} is not empty: give --resume to go on with an interrupted training, or another --out")
    if resume:
        check_folder(out, asked, resume=True, overwrite=False)
    prepare_folder(out, asked, clean=False)
    history = _learn(make_program(config), env, config, out, seed)
    with checkpoints(out / TRAINING, read_only=True) as saved:
        shapes = jax.eval_shape(make_program(config).init, env, jax.random.key(seed))
        state = saved.restore({"state": shapes})["state"]
    made = finished(config, env, state)
    reward = validate(made, env, eval_steps)
    about = {
        **described,
        "seed": seed,
        "reward": round(reward, 4),
        "eval_steps": eval_steps,
        **provenance(),
        "command": command,
        "history": {"columns": ["round", "wall_s", "reward", "loss"], "rows": history[:: max(1, len(history) // 50)]},
    }
    stored.save(out, made, about)
    shutil.rmtree(out / TRAINING)
    (out / HISTORY).unlink()
    (out / "config.json").unlink()
    return reward


def _learn(program: TeacherProgram, env: Any, config: TeacherConfig, out: Path, seed: int) -> list[list[float]]:
    """All rounds, from wherever the folder's newest checkpoint is. Returns (round, wall_s, reward, loss) a stretch."""
    file = out / HISTORY
    with checkpoints(out / TRAINING) as saved, interruptible() as stopping, progress_bars() as bars:
        state = program.init(env, jax.random.key(seed))
        history = []
        if saved.latest() is not None:
            state = saved.restore({"state": jax.eval_shape(lambda: state)})["state"]
            history = [row for row in json.loads(file.read_text()) if row[0] <= int(state.round)]
        before = history[-1][1] if history else 0.0
        started, kept = time.perf_counter(), time.perf_counter()
        bar = bars.add_task("teacher", total=config.rounds, note="", completed=int(state.round))
        while (done := int(state.round)) < config.rounds:
            state, metrics = program.train(env, state, min(ROUNDS_A_STRETCH, config.rounds - done))
            reward, loss, now = float(metrics["reward"]), float(metrics["loss"]), time.perf_counter()
            history.append([int(state.round), round(before + now - started, 1), round(reward, 4), round(loss, 5)])
            bars.update(bar, completed=int(state.round), note=f"reward {reward:.3f} loss {loss:.4f}")
            if now - kept > SECONDS_BETWEEN_CHECKPOINTS or stopping.is_set() or int(state.round) >= config.rounds:
                file.write_text(json.dumps(history))
                saved.save(int(state.round), {"state": state})
                kept = time.perf_counter()
            if stopping.is_set():
                raise Interrupted(f"stopped at round {int(state.round)}; go on with the same command and --resume")
    return history


def validate(made: LearnedTeacher, env: Any, steps: int) -> float:
    """Reward a step of a teacher's own choices on validation episodes."""
    found = evaluate_policy(env, Taught(made), episodes(), min(100, steps), steps)
    return float(np.asarray(found["reward"]))
