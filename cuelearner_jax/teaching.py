"""Training a teacher on the host: progress, validation, the finished teacher on disk."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cuelearner_jax import config as configuration
from cuelearner_jax import results, teacher
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import VALIDATION, rollout, teacher_policy
from cuelearner_jax.sweep import console, progress_bars
from cuelearner_jax.tasks import Task
from cuelearner_jax.teacher import LearnedTeacher, TeacherConfig

ROUNDS_A_STRETCH = 50


def check(config: TeacherConfig, out: Path) -> None:
    """Raises UserError for values that cannot work."""
    for name in ("tables", "search", "directions", "memory", "updates", "batch_size", "rounds"):
        if getattr(config, name) < 1:
            raise UserError(f"teacher.{name} is {getattr(config, name)}: give a positive number")
    if config.tries < 4:
        raise UserError(f"teacher.tries is {config.tries}: give at least 4 (the best, a promising one, two uniform ones)")
    if not config.layers:
        raise UserError("teacher.layers: give at least one layer")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} is not empty: give another --out")


def train(
    task: Task, world: Any, config: TeacherConfig, out: Path, seed: int, eval_steps: int, command: str
) -> float:
    """Trains a teacher for a world (a task configuration), validates it and writes it.

    Returns:
        Its reward a step over `eval_steps` validation steps.
    """
    check(config, out)
    env = task.environment(world)
    if not hasattr(env, "features"):
        raise UserError(f"{task.name} gives a teacher no features to learn from")
    program = teacher.make_program(config)
    state = program.init(env, jax.random.key(seed))
    history, started = [], time.perf_counter()
    with progress_bars() as bars:
        bar = bars.add_task("teacher", total=config.rounds, note="")
        while (done := int(state.round)) < config.rounds:
            state, metrics = program.train(env, state, min(ROUNDS_A_STRETCH, config.rounds - done))
            reward, loss = float(metrics["reward"]), float(metrics["loss"])
            history.append([int(state.round), round(time.perf_counter() - started, 1), round(reward, 4), round(loss, 5)])
            bars.update(bar, completed=int(state.round), note=f"reward {reward:.3f} loss {loss:.4f}")
    wall = time.perf_counter() - started
    made = teacher.finished(config, env, state)
    reward = validate(made, env, eval_steps)
    shots = config.rounds * config.tables * config.tries
    console.print(f"{shots / 1e6:.1f} million tries in {wall:.0f} s")
    about = {
        "task": {"name": task.name, **configuration.to_json(world)},
        "seed": seed,
        "reward": round(reward, 4),
        "eval_steps": eval_steps,
        "wall_s": round(wall, 1),
        **results.provenance(),
        "command": command,
        "history": {"columns": ["round", "wall_s", "reward", "loss"], "rows": history[:: max(1, len(history) // 50)]},
    }
    teacher.save(out, made, config, about)
    return reward


def validate(made: LearnedTeacher, env: Any, steps: int) -> float:
    """Reward a step of a teacher's own choices on validation episodes."""
    key = jax.random.fold_in(jax.random.key(0), VALIDATION)
    envs = min(100, steps)
    measure = jax.jit(lambda made, env: rollout(teacher_policy(made), env, key, envs, steps))
    return float(np.asarray(measure(made, env)["reward"]))
