"""A learned teacher's folder: its network in half precision, and teacher.json: what it is and how it was made."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cuelearner_jax.config import from_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.records import formats
from cuelearner_jax.records.checkpoint import checkpoints
from cuelearner_jax.teachers.learned import LearnedTeacher, TeacherConfig
from cuelearner_jax.teachers.program import Trainer


def save(folder: Path, teacher: LearnedTeacher, about: dict[str, Any]) -> None:
    """Writes a teacher: its network in half precision, and teacher.json: what it is and how it was made.

    `about` must hold the `config` (a TeacherConfig's fields) under that name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / "network").exists():  # an earlier teacher's, which would be kept
        shutil.rmtree(folder / "network")
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float16), teacher.params)
    with checkpoints(folder / "network") as saved:
        saved.save(0, {"params": params})
    formats.write("teacher", folder / "teacher.json", about)


def load(folder: Path, env: Any, aim_error: Any, habit: Any) -> LearnedTeacher:
    """A teacher that `save` wrote. Raises UserError if there is none, or one of another task."""
    if not (folder / "teacher.json").is_file():
        raise UserError(f"no teacher in {folder}: train one with `cuelearner teacher train`, or use the search teacher")
    about = formats.read("teacher", folder / "teacher.json")
    try:
        config = from_json(TeacherConfig, about["config"])
    except (ValueError, KeyError, TypeError) as error:
        raise formats.damaged("teacher", folder / "teacher.json") from error
    template = jax.eval_shape(Trainer(config).init, env, jax.random.key(0)).params
    halves = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float16), template)
    with checkpoints(folder / "network", read_only=True) as saved:
        params = saved.restore({"params": halves})["params"]
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), params)
    aim = jnp.asarray(aim_error, jnp.float32), jnp.asarray(habit, jnp.float32)
    return LearnedTeacher(env, params, *aim, config.layers, config.directions)
