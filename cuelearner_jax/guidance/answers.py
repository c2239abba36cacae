"""What a teacher answers: the forms of feedback, and the faults of a simulated teacher (paper, section IV-A)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax import actions as geometry
from cuelearner_jax.config import Scalars
from cuelearner_jax.guidance.bundle import AnswerForm
from cuelearner_jax.types import EnvState, Teacher


def relative_feedback(
    action: Float[Array, " action"],
    best: Float[Array, " action"],
    eps: Float[Array, ""] | float,
    indifference: Float[Array, ""] | float = 0.0,
) -> Float[Array, ""]:
    """h in {-1, 0, +1}: which of the turns by -eps, 0, +eps [rad] brings `action` nearest to `best`.

    0 ("already right") therefore means within eps / 2; `indifference` [rad] widens that.
    """
    right = geometry.distance(action, best) <= jnp.maximum(eps / 2, indifference)
    return jnp.where(right, 0.0, geometry.sense(action, best))


def relative_answer(
    key: PRNGKeyArray,
    teacher: Teacher,
    state: EnvState,
    obs: Float[Array, " obs"],
    action: Float[Array, " action"],
    scalars: Scalars,
) -> tuple[Float[Array, "1"], Bool[Array, ""]]:
    """h of a teacher with the faults of `scalars`, and whether it answered."""
    h, answered = human_answer(key, action, teacher.best_action(state, obs), scalars)
    return h[None], answered


def human_answer(
    key: PRNGKeyArray, action: Float[Array, " action"], best: Float[Array, " action"], scalars: Scalars
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The answer of somebody with the faults of `scalars` who would do `best`: (h, answered)."""
    key_mistake, key_silence = jax.random.split(key)
    believed = geometry.rotate(best, scalars.radians("teacher_bias"))
    h = relative_feedback(action, believed, scalars.radians("eps"), scalars.radians("indifference"))
    mistaken = jax.random.bernoulli(key_mistake, scalars.mistake_probability)
    silent = jax.random.bernoulli(key_silence, scalars.silence_probability)
    return jnp.where(mistaken, -h, h), ~silent


RELATIVE = AnswerForm(
    name="relative",
    width=1,
    meaning="h: +1 turn it counterclockwise, 0 already right, -1 turn it clockwise, by eps",
    answer=relative_answer,
    values=(-1.0, 0.0, 1.0),
)
