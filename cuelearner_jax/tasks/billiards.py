"""Define the billiards task: its teachers, presets, changed worlds and pictures."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from cuelearner_envs import billiards
from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.teacher import LocalSearchTeacher, SearchTeacher, Transferred
from cuelearner_jax import teachers
from cuelearner_jax.errors import UserError
from cuelearner_jax.task import Body, Pictures, Task
from cuelearner_jax.tasks import presets
from cuelearner_jax.types import Teacher

SHIPPED_TEACHERS = Path(billiards.__file__).parent / "teachers"
# Fields in which a learned teacher's world may differ from its own: the teacher and its search, data augmentation, and
# changes that `Transferred` accounts for.
TEACHERS = ("teacher", "aim_error_deg", "habit", "search_directions")
TRANSFERRED = (*TEACHERS, "mirrors", "action_turn_deg", "observation_bias")
# largest tilt at which a learned teacher still proposes nearly good shots [m/s^2], see docs/billiards.md
SLIGHT_TILT = 0.02
LOCAL_SEARCH = "local_search"


def teacher_folder(config: BilliardsConfig) -> Path | None:
    """Return the folder of a configuration's teacher; None for one that was not trained."""
    if config.teacher == "search":
        return None
    return SHIPPED_TEACHERS / config.table if config.teacher in ("learned", LOCAL_SEARCH) else Path(config.teacher)


def make_teacher(config: BilliardsConfig, env: Any) -> Teacher:
    """Return the teacher of a configuration."""
    aim_error = jnp.deg2rad(jnp.array(config.aim_error_deg, jnp.float32))
    habit = jnp.array(config.habit, jnp.float32)
    if (folder := teacher_folder(config)) is None:
        return SearchTeacher(env, aim_error, habit, config.search_directions)
    trained_in = _learned_in(folder, config)
    own = make_environment(trained_in)
    network = teachers.load(folder, own, aim_error, habit)
    if config.teacher == LOCAL_SEARCH or trained_in.acceleration != tuple(config.acceleration):
        return LocalSearchTeacher(network, own, env, aim_error, habit)
    return Transferred(network, own, env)


def _learned_in(folder: Path, config: BilliardsConfig) -> BilliardsConfig:
    """Return the training world of a teacher used in another world. Raises UserError for a change it cannot handle.

    On a slightly tilted table its proposals are still near good shots; simulated shots then decide among them.
    """
    try:
        return teachers.world_of(folder, "billiards", config, TRANSFERRED)
    except UserError as refusal:
        with suppress(UserError):
            trained_in = teachers.world_of(folder, "billiards", config, (*TRANSFERRED, "acceleration"))
            if math.dist(trained_in.acceleration, config.acceleration) <= SLIGHT_TILT:
                return trained_in
        raise refusal


def _files(config: BilliardsConfig) -> dict[str, str]:
    """Return the digest of the user's own teacher, if there is one."""
    folder = teacher_folder(config)
    own = folder and config.teacher not in ("learned", LOCAL_SEARCH)
    return {"teacher": teachers.digest(folder)} if folder and own else {}


def _pictures() -> Pictures:
    from cuelearner_envs.billiards import drawing  # takes seconds to load
    from cuelearner_envs.billiards.sketch import record, reel, sketch, trails

    return Pictures(
        record=record,
        still=lambda env, paths, file: drawing.still(env.table, paths[0], file),
        animate=lambda env, paths, file: drawing.animate(env.table, paths, file),
        question=lambda env, state, obs, action, file: drawing.question(
            env.table, state.positions, state.pocketed, action, file
        ),
        sketch=sketch,
        reel=reel,
        trails=trails,
        legend="Thin lines: the paths of the white ball (solid) and of the ball that it hits (dashed), within three "
        "seconds. A disc: a ball is pocketed. A cross: the white ball is pocketed, a foul.",
    )


PLAYER = Body(
    name="player",
    about="strikes the cue ball with a fixed speed",
    # splits differ only in the racks, which the key determines
    environment=lambda config, split: make_environment(config),
    pictures=_pictures,
)


BILLIARDS = Task(
    name="billiards",
    about="pocket the target balls with one shot a step",
    wants=lambda config: (
        "The white ball is struck along the arrow. A coloured ball should be pocketed, the white ball never."
    ),
    near_aims=True,
    config=BilliardsConfig,
    bodies=(PLAYER,),
    teacher=make_teacher,
    files=_files,
    labels_hold=("mirrors", *TEACHERS),
    **presets.read("billiards", BilliardsConfig()),
)
