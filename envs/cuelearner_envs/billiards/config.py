"""Configuration of the billiards task: table, changes of the world, teacher."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp

from cuelearner_envs.billiards.environment import Billiards
from cuelearner_envs.billiards.table import Table
from cuelearner_envs.bounds import check_number, check_vector, check_word

MOST_DIRECTIONS = 100_000  # the teacher simulates a shot for each direction in every state
SHOTS = {"one_ball": 1, "easy": 10, "regulation": 10}  # of an episode


@dataclass(frozen=True)
class BilliardsConfig:
    """A billiards world and its teacher."""

    table: Literal["one_ball", "easy", "regulation"] = "regulation"
    """one_ball: one large target, one shot. easy: three large targets. regulation: the paper's table."""
    mirrors: bool = False
    """Add the mirror images of transitions on an unchanged table to replay; labels are not mirrored."""
    action_turn_deg: float = 0.0
    """Changed world: every strike is rotated counterclockwise by this angle [deg] (paper: 0.8)."""
    observation_bias: tuple[float, float] = (0.0, 0.0)
    """Changed world: offset of the observed positions of balls on the table, x and y [m] (paper: 0.0071 0.0071)."""
    acceleration: tuple[float, float] = (0.0, 0.0)
    """Changed world: constant acceleration of the balls on a tilted table, x and y [m/s^2] (paper: 0 0.005)."""
    teacher: str = "search"
    """Teacher: search (tries every direction), learned (shipped for easy and regulation), local_search (tries shots
    near the learned teacher's proposals), or a folder made by `experiments/train_teacher.py`."""
    aim_error_deg: float = 0.5
    """Standard deviation of the aim of the player for whom the teacher evaluates directions [deg]."""
    habit: float = 0.2
    """Share by which the teacher reduces values over a full counterclockwise turn from x, which settles ties
    consistently."""
    search_directions: int = 1440
    """Number of directions that the search teacher tries in every state."""

    def __post_init__(self) -> None:
        """Raise UserError with one line for the first value that cannot work."""
        check_word("table", self.table, SHOTS)
        check_number("action_turn_deg", self.action_turn_deg, -360, 360, unit="degrees")
        check_vector("observation_bias", self.observation_bias, 2, -1, 1, "metres")
        check_vector("acceleration", self.acceleration, 2, -9.81, 9.81, "m/s^2")
        check_number("aim_error_deg", self.aim_error_deg, 0, 360, unit="degrees")
        check_number("habit", self.habit, 0, 1)
        check_number("search_directions", self.search_directions, 1, MOST_DIRECTIONS, whole=True)


def make_environment(config: BilliardsConfig) -> Billiards:
    """Return the environment of a configuration."""
    table: Table = getattr(Table, config.table)()
    return Billiards(
        table=table.replace(acceleration=jnp.array(config.acceleration, jnp.float32)),
        action_turn=jnp.deg2rad(jnp.array(config.action_turn_deg, jnp.float32)),
        observation_bias=jnp.array(config.observation_bias, jnp.float32),
        max_shots=SHOTS[config.table],
        mirrors=config.mirrors,
    )
