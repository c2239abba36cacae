"""Configuration of the billiards task: which table, which changes of the world, which teacher."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp

from cuelearner_envs.billiards.environment import Billiards
from cuelearner_envs.billiards.table import Table
from cuelearner_envs.bounds import check_number, check_vector, check_word

MOST_DIRECTIONS = 100_000  # a shot is simulated for each, in every state that the teacher looks at
SHOTS = {"one_ball": 1, "easy": 10, "regulation": 10}  # of an episode


@dataclass(frozen=True)
class BilliardsConfig:
    """A billiards world and its teacher."""

    table: Literal["one_ball", "easy", "regulation"] = "regulation"
    """one_ball: one large target, one shot. easy: three large targets. regulation: the paper's table."""
    mirrors: bool = False
    """Multiply transitions by the mirror images of an unchanged table; labels stay as they were given."""
    action_turn_deg: float = 0.0
    """Changed world: every strike is turned by this, counterclockwise [deg] (paper: 0.8)."""
    observation_bias: tuple[float, float] = (0.0, 0.0)
    """Changed world: added to the observed positions of balls on the table, x and y [m] (paper: 0.0071 0.0071)."""
    acceleration: tuple[float, float] = (0.0, 0.0)
    """Changed world: constant acceleration of the balls on a tilted table, x and y [m/s^2] (paper: 0 0.005)."""
    teacher: str = "search"
    """Who labels: search (every direction is tried), learned (shipped for easy and regulation), local_search (shots
    near what the learned one proposes are tried), or a folder that `experiments/train_teacher.py` made."""
    aim_error_deg: float = 0.5
    """The teacher values directions for a player whose aim has this standard deviation [deg]."""
    habit: float = 0.2
    """The teacher shrinks values by this share over a full turn counterclockwise from x: settles ties the same way."""
    search_directions: int = 1440
    """Search teacher: directions that it tries in every state."""

    def __post_init__(self) -> None:
        """Raise UserError with one line for the first value that cannot work."""
        check(self)


def check(config: BilliardsConfig) -> None:
    """Raise UserError with one line for the first value that cannot work."""
    check_word("table", config.table, SHOTS)
    check_number("action_turn_deg", config.action_turn_deg, -360, 360, unit="degrees")
    check_vector("observation_bias", config.observation_bias, 2, -1, 1, "metres")
    check_vector("acceleration", config.acceleration, 2, -9.81, 9.81, "m/s^2")
    check_number("aim_error_deg", config.aim_error_deg, 0, 360, unit="degrees")
    check_number("habit", config.habit, 0, 1)
    check_number("search_directions", config.search_directions, 1, MOST_DIRECTIONS, whole=True)


def make_environment(config: BilliardsConfig) -> Billiards:
    """The world that a configuration describes."""
    table: Table = getattr(Table, config.table)()
    return Billiards(
        table=table.replace(acceleration=jnp.array(config.acceleration, jnp.float32)),
        action_turn=jnp.deg2rad(jnp.array(config.action_turn_deg, jnp.float32)),
        observation_bias=jnp.array(config.observation_bias, jnp.float32),
        max_shots=SHOTS[config.table],
        mirrors=config.mirrors,
    )
