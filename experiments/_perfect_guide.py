"""A guide that needs no labels: the billiards tables' shipped teachers strike for it. How far can guidance go at all?

    python experiments/billiards_bootstrapping.py --pieces regulation/frame/perfect

The kinds are named as `_perfect_guide:REGULATION` and `_perfect_guide:EASY` wherever a kind of guidance is asked for,
in the folder that holds this file or by a script in it. What such a guide earns alone is measured beside the agents.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_jax import teachers
from cuelearner_jax.config import GuideScalars
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.guides.base import Kind
from cuelearner_jax.guides.baselines import Untaught
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.tasks.billiards import AGENT, SHIPPED_TEACHERS
from cuelearner_jax.teachers import LearnedTeacher
from cuelearner_jax.types import GuidanceModel


@lru_cache
def teacher(table: str) -> LearnedTeacher:
    """The table's shipped network, which aims without error. Its arrays are NumPy's: constants of any program."""
    with jax.ensure_compile_time_eval():
        found = teachers.load(SHIPPED_TEACHERS / table, make_environment(BilliardsConfig(cast(Any, table))), 0.0, 0.0)
    return jax.device_get(found)


class Perfect(Untaught):
    """The teacher of the table that the kind is named after strikes."""

    def act(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Return the teacher's best action in active rows, searched near the peaks, as agents do."""
        told = teacher(self.name.removeprefix("perfect-"))
        agent = replace(AGENT, q_layers=told.layers, directions=told.directions)
        functions = agent.make("action", spaces_of(env))
        best = functions.explore(env, agent, told.params, obs, jax.random.key(0))  # draws nothing
        return Refinement(jnp.where(active[:, None], best, actions), active.astype(jnp.int32))


def _kind(table: str) -> Kind:
    return Kind(f"perfect-{table}", "the teacher's best shot", Perfect, title="perfect", colour="#6A3D9A")


REGULATION, EASY = _kind("regulation"), _kind("easy")
