"""Configuration of the billiards task: table, changes of the world, teacher."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import jax.numpy as jnp

from cuelearner_envs.billiards.environment import Billiards
from cuelearner_envs.billiards.table import Table
from cuelearner_jax.config import SHARE, Bounds, check_part

SHOTS = {"one_ball": 1, "easy": 10, "regulation": 10}  # of an episode


@dataclass(frozen=True)
class BilliardsConfig:
    """A billiards world and its teacher."""

    table: Literal["one_ball", "easy", "regulation"] = "regulation"
    """one_ball: one large target, one shot. easy: three large targets. regulation: the paper's table."""
    mirrors: bool = False
    """Add the mirror images of transitions on an unchanged table to replay (a changed one has no mirror images); labels
    are not mirrored."""
    action_turn_deg: Annotated[float, Bounds(-360, 360)] = 0.0
    """Changed world: every strike is rotated counterclockwise by this angle [deg] (paper: 0.8)."""
    observation_bias: Annotated[tuple[float, float], Bounds(-1, 1)] = (0.0, 0.0)
    """Changed world: offset of the observed positions of balls on the table, x and y [m] (paper: 0.0071 0.0071)."""
    acceleration: Annotated[tuple[float, float], Bounds(-9.81, 9.81)] = (0.0, 0.0)
    """Changed world: constant acceleration of the balls on a tilted table, x and y [m/s^2] (paper: 0 0.005)."""
    teacher: str = "search"
    """Teacher: search (tries every direction), learned (shipped for easy and regulation), local_search (tries shots
    near the learned teacher's proposals), or a folder made by `experiments/train_teacher.py`."""
    aim_error_deg: Annotated[float, Bounds(0, 360)] = 0.5
    """Standard deviation of the aim of the player for whom the teacher evaluates directions [deg]."""
    habit: Annotated[float, SHARE] = 0.2
    """Share by which the teacher reduces values over a full counterclockwise turn from x, which settles ties
    consistently."""
    search_directions: Annotated[int, Bounds(1, 100_000)] = 1440
    """Number of directions that the search teacher tries in every state."""

    def __post_init__(self) -> None:
        """Raise UserError with one line for the first value that cannot work."""
        check_part(self, "task")


def make_environment(config: BilliardsConfig) -> Billiards:
    """Return the environment of a configuration."""
    table: Table = getattr(Table, config.table)()
    return Billiards(
        table=table.replace(acceleration=jnp.array(config.acceleration, jnp.float32)),
        action_turn=jnp.deg2rad(jnp.array(config.action_turn_deg, jnp.float32)),
        observation_bias=jnp.array(config.observation_bias, jnp.float32),
        max_shots=SHOTS[config.table],
        mirrors=config.mirrors and not any((config.action_turn_deg, *config.observation_bias, *config.acceleration)),
    )
