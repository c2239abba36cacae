"""A guide that needs no labels: the billiards tables' shipped teachers strike for it. How far can guidance go at all?

    python experiments/billiards_bootstrapping.py --pieces regulation/frame/perfect

The kinds are named as `_perfect_guide:REGULATION` and `_perfect_guide:EASY` wherever a kind of guidance is asked for,
in the folder that holds this file or by a script in it. What such a guide earns alone is measured beside the agents.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_jax.actions import DIRECTIONS
from cuelearner_jax.agents.choice import greedy_actions
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guides.bundle import Guidance
from cuelearner_jax.guides.kind import Kind
from cuelearner_jax.guides.refining import Refined
from cuelearner_jax.guides.unlabelled import unlabelled
from cuelearner_jax.tasks.billiards import SEEN_FROM_THE_STRIKE, SHIPPED_TEACHERS
from cuelearner_jax.teachers import stored
from cuelearner_jax.teachers.learned import LearnedTeacher
from cuelearner_jax.types import GuidanceModel

Table = Literal["regulation", "easy"]


@lru_cache
def teacher(table: Table) -> LearnedTeacher:
    """The table's shipped network, which aims without error. Its arrays are NumPy's: constants of any program."""
    with jax.ensure_compile_time_eval():
        found = stored.load(SHIPPED_TEACHERS / table, make_environment(BilliardsConfig(table)), 0.0, 0.0)
    return jax.device_get(found)


def act(
    table: Table,
    model: GuidanceModel,
    env: Any,
    obs: Float[Array, "n obs"],
    actions: Float[Array, "n action"],
    active: Bool[Array, " n"],
    scalars: GuideScalars,
) -> Refined:
    """The teacher's best action in active rows; searched near the peaks, as agents search theirs: it is asked often."""
    told = teacher(table)
    sizes = replace(SEEN_FROM_THE_STRIKE, q_layers=told.layers, directions=told.directions)
    best = greedy_actions(sizes, DIRECTIONS, env, told.params, obs)
    return Refined(jnp.where(active[:, None], best, actions), active.astype(jnp.int32))


def make(table: Table, sizes: GuideSizes, spaces: Spaces) -> Guidance:
    """The bundle."""
    return unlabelled(f"perfect-{table}", partial(act, table))


def _kind(table: Table) -> Kind:
    return Kind(f"perfect-{table}", "the teacher's best shot", partial(make, table), title="perfect", colour="#6A3D9A")


REGULATION, EASY = _kind("regulation"), _kind("easy")
