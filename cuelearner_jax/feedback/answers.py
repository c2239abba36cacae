"""What a teacher answers: the forms of feedback, and the faults of a simulated teacher (paper, section IV-A)."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax import actions as geometry
from cuelearner_jax.actions import DIRECTIONS
from cuelearner_jax.config import GuideScalars, Scalars, TeacherFaults
from cuelearner_jax.errors import UserError, shown
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.types import EnvState, Teacher, ValuesDirections

GuideScalarsT = TypeVar("GuideScalarsT", bound=GuideScalars)


def check_teacher(teacher: Any, faults: TeacherFaults) -> None:
    """Raises UserError if a teacher cannot answer about what it is to have in mind."""
    if faults.answer == "nearest" and not isinstance(teacher, ValuesDirections):
        raise UserError(
            "scalars.answer is nearest, but this teacher knows the best action alone, not what others are worth: "
            "give --scalars.answer best"
        )


def in_mind(
    teacher: Teacher, state: EnvState, obs: Float[Array, " obs"], action: Float[Array, " action"], scalars: Scalars
) -> Float[Array, " action"]:
    """What a teacher would have done instead of an action, but for its bias: its best, or the nearest that is good.

    The second is the paper's Eq. 2 to the letter, whose answers follow a local gradient.
    """
    if scalars.answer == "best":
        return _taught(teacher, teacher.best_action(state, obs), action)
    assert isinstance(teacher, ValuesDirections)  # see `check_teacher`
    # One with a bias takes everything for turned by it: what it looks for lies round the action turned back.
    seen = geometry.rotate(action, -scalars.radians("teacher_bias"))
    spread = scalars.radians("nearest_aim")
    return _taught(teacher, teacher.nearest_good(state, obs, seen, spread, scalars.nearest_share), action)


def _taught(teacher: Any, given: Any, action: Float[Array, " action"]) -> Float[Array, " action"]:
    """A teacher's action; NaN where it is none. Raises UserError if it has another shape than actions have."""
    wanted = f"give an action of shape {action.shape}, of real numbers"
    try:
        found = jnp.asarray(given)
    except (TypeError, ValueError) as error:
        raise UserError(f"teacher {type(teacher).__name__} gave {shown(given)}: {wanted}") from error
    if found.shape != action.shape:
        raise UserError(f"teacher {type(teacher).__name__} gave an action of shape {found.shape}: {wanted}")
    if not jnp.issubdtype(found.dtype, jnp.floating) and not jnp.issubdtype(found.dtype, jnp.integer):
        raise UserError(f"teacher {type(teacher).__name__} gave {found.dtype} numbers: {wanted}")
    return geometry.only_actions(found.astype(action.dtype))


def of_strength(scalars: GuideScalarsT, eps_deg: Float[Array, "*labels"] | None) -> GuideScalarsT:
    """Scalars under which answers of that strength [deg] were given; None: of the scalars' own."""
    return scalars if eps_deg is None else dataclasses.replace(scalars, eps_deg=eps_deg)


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
    env: Any,
    teacher: Teacher,
    state: EnvState,
    obs: Float[Array, " obs"],
    action: Float[Array, " action"],
    scalars: Scalars,
) -> tuple[Float[Array, "1"], Bool[Array, ""]]:
    """h of a teacher with the faults of `scalars`, and whether it answered."""
    h, answered = human_answer(key, action, in_mind(teacher, state, obs, action, scalars), scalars)
    return h[None], answered


def human_answer(
    key: PRNGKeyArray, action: Float[Array, " action"], best: Float[Array, " action"], scalars: Scalars
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """The answer of somebody with the faults of `scalars` who would do `best`: (h, answered)."""
    mistaken, answered = _slips(key, scalars)
    believed = geometry.rotate(best, scalars.radians("teacher_bias"))
    h = relative_feedback(action, believed, scalars.radians("eps"), scalars.radians("indifference"))
    return jnp.where(mistaken, -h, h), answered


def demonstrated(
    key: PRNGKeyArray,
    env: Any,
    teacher: Teacher,
    state: EnvState,
    obs: Float[Array, " obs"],
    action: Float[Array, " action"],
    scalars: Scalars,
) -> tuple[Float[Array, " action"], Bool[Array, ""]]:
    """What a teacher with the faults of `scalars` shows in place of an action, and whether it shows anything.

    One that is indifferent shows the action itself where that is near enough. A mistaken one turns it as far the other
    way: the mirror image of what it meant to show.
    """
    mistaken, answered = _slips(key, scalars)
    wanted = geometry.rotate(in_mind(teacher, state, obs, action, scalars), scalars.radians("teacher_bias"))
    right = geometry.distance(action, wanted) <= scalars.radians("indifference")
    mirrored = geometry.rotate(action, -geometry.difference(action, wanted))
    return jnp.where(right, action, jnp.where(mistaken, mirrored, wanted)), answered


def scalar_answer(
    key: PRNGKeyArray,
    env: Any,
    teacher: Teacher,
    state: EnvState,
    obs: Float[Array, " obs"],
    action: Float[Array, " action"],
    scalars: Scalars,
) -> tuple[Float[Array, "1"], Bool[Array, ""]]:
    """1 for a good action and 0 for another, of a teacher with the faults of `scalars`; and whether it answered.

    Good is an action within `scalar_within_deg` of what the teacher has in mind (paper, appendix), or, where
    `scalar_good` says so, one that is rewarded at once as well (the paper's public code).
    """
    mistaken, answered = _slips(key, scalars)
    wanted = geometry.rotate(in_mind(teacher, state, obs, action, scalars), scalars.radians("teacher_bias"))
    within = jnp.maximum(scalars.radians("scalar_within"), scalars.radians("indifference"))
    good = geometry.distance(action, wanted) <= within
    if scalars.scalar_good == "scored":
        good |= env.step(jax.random.fold_in(key, 0), state, action)[1].reward > 0
    said = jnp.where(jnp.isfinite(wanted).all(), (good != mistaken).astype(jnp.float32), jnp.nan)
    return said[None], answered


def _slips(key: PRNGKeyArray, scalars: Scalars) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Is the teacher mistaken this time, and does it answer?"""
    key_mistake, key_silence = jax.random.split(key)
    mistaken = jax.random.bernoulli(key_mistake, scalars.mistake_probability)
    silent = jax.random.bernoulli(key_silence, scalars.silence_probability)
    return mistaken, ~silent


RELATIVE = AnswerForm(
    name="relative",
    width=1,
    meaning="h: +1 turn it counterclockwise, 0 already right, -1 turn it clockwise, by eps",
    answer=relative_answer,
    values=(-1.0, 0.0, 1.0),
    by_eps=True,
)
DEMONSTRATION = AnswerForm(
    name="demonstration",
    width=DIRECTIONS.size,
    meaning="x, y of what to do instead, a unit vector",
    answer=demonstrated,
    is_action=True,
)
SCALAR = AnswerForm(
    name="scalar",
    width=1,
    meaning="1 a good action, 0 another",
    answer=scalar_answer,
    values=(0.0, 1.0),
)
