"""Billiards in Chipmunk at the fixed step of the public code's simulator, in processes.

That simulator plays on pymunk with steps of 0.02 s; the package computes each impact. `_agent_teacher:TASK` has it as
the body `chipmunk`. Its teacher tries shots near the shipped network's in Chipmunk itself.
"""

from __future__ import annotations

import dataclasses
import sys
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.foreign import ForeignBilliards
from cuelearner_envs.billiards.processes import Played
from cuelearner_envs.billiards.table import Table
from cuelearner_jax.errors import UserError
from cuelearner_jax.task import Body

STEP = 0.02  # [s]
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))  # which hold the table in pymunk


class Chipmunk(NamedTuple):
    """A table in Chipmunk (`cuelearner_envs.billiards.processes.Engine`)."""

    table: str
    step: float  # [s]

    def __call__(self, positions: np.ndarray, pocketed: np.ndarray, angles: np.ndarray) -> Played:
        """Play shots one after another."""
        game = _opened(self.table, self.step)
        rows = [self._shot(game, *shot) for shot in zip(positions, pocketed, angles, strict=True)]
        kinds = (np.float32, bool, np.float32, np.int32, bool)
        return Played(*(np.array(column, kind) for column, kind in zip(zip(*rows, strict=True), kinds, strict=True)))

    def _shot(self, game: Any, positions: np.ndarray, pocketed: np.ndarray, angle: float) -> tuple[Any, ...]:
        places, out = positions.copy(), pocketed.copy()
        rests, fell, seconds = game.play(positions[~pocketed], float(angle))
        places[~pocketed], out[~pocketed] = rests, fell
        return places, out, seconds, round(seconds / self.step), False


@lru_cache(maxsize=2)
def _opened(table: str, step: float) -> Any:
    from pymunk_table import PymunkTable  # pyright: ignore[reportMissingImports]

    return PymunkTable(getattr(Table, table)(), step)


def _in_chipmunk(config: BilliardsConfig, split: str) -> ForeignBilliards:
    """The world of a configuration. Raises UserError for a tilted table, which this engine is not given."""
    if any(config.acceleration):
        raise UserError("the table in Chipmunk is level: leave out --task.acceleration")
    own = make_environment(config)
    fields = {field.name: getattr(own, field.name) for field in dataclasses.fields(own)}
    return ForeignBilliards(**fields, engine=Chipmunk(config.table, STEP))


BODY = Body("chipmunk", "strikes on a table simulated by Chipmunk with steps of 0.02 s", environment=_in_chipmunk)
