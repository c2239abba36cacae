"""Answers of a simulated teacher: the forms of feedback and the teacher's faults (paper, section IV-A)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import Scalars, TeacherFaults
from cuelearner_jax.environment import actions_of
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.spaces import UNSAID, Space
from cuelearner_jax.types import Action, EnvState, Number, Observation, Teacher, ValuesDirections

SECOND = 2  # stream of a question's second action, beside the faults of the answer by the same key


class AnswerForm(NamedTuple):
    """A form of answer. Label files hold its name; every guide with the same form can use them."""

    name: str
    width: Callable[[Space], int]  # entries of an answer
    meaning: Callable[[Space], str]  # meaning of its entries, in a few words
    # (key, env, teacher, state, obs, action, scalars) -> (answer (answer,), answered): of a simulated teacher about an
    # action in a situation, with the faults of `scalars`
    answer: Callable[..., tuple[Array, Array]]
    values: Callable[[Space], tuple[float, ...]] | None = None  # allowed values of an entry; None: any finite number
    is_action: bool = False  # True if an answer is itself an action
    # True if an answer means a change by eps, which label files then record; 2 then means that nothing was said
    by_eps: bool = False
    # (space, action, answer, eps) -> the action that the answer asks for; None: an answer names none
    correct: Callable[[Space, Array, Array, Array], Array] | None = None
    # (key, space, action, scalars) -> the second action of a question about a pair; None: questions show one action.
    # An answer is then (choice, *second action), and `answer` takes the second action of an earlier question too.
    second: Callable[[PRNGKeyArray, Space, Array, Any], Array] | None = None

    def choice(self, answer: Any) -> Any:
        """Return what answers (..., answer) say, without the second action of a pair."""
        return answer if self.second is None else answer[..., :1]


def check_teacher(teacher: Any, faults: TeacherFaults) -> None:
    """Raise UserError if a teacher cannot give the answers that `scalars.answer` asks for."""
    if faults.answer == "nearest" and not isinstance(teacher, ValuesDirections):
        why = "scalars.answer is nearest, but this teacher knows only the best action, not the values of others"
        raise UserError(f"{why}: give --scalars.answer best")


def intended_action(
    space: Space, teacher: Teacher, state: EnvState, obs: Observation, action: Action, scalars: Scalars
) -> Action:
    """Return the action that a teacher intends in place of `action`, apart from its bias.

    The intended action is the teacher's best one or, with `scalars.answer` "nearest", the nearest good one: the paper's
    Eq. 2 to the letter, whose answers follow a local gradient.
    """
    if scalars.answer != "nearest":
        return _taught(space, teacher, teacher.best_action(state, obs), action)
    assert isinstance(teacher, ValuesDirections)  # see `check_teacher`
    # A biased teacher sees every action with the bias, so it searches around the action without the bias.
    perceived = add_bias(space, action, -space.from_unit(scalars.teacher_bias_deg))
    spread = space.from_unit(scalars.nearest_aim_deg)
    return _taught(space, teacher, teacher.nearest_good(state, obs, perceived, spread, scalars.nearest_share), action)


def add_bias(space: Space, action: Action, bias: Float[Array, ""]) -> Action:
    """Return an action changed by a constant error along every cue."""
    return space.toward(action, jnp.ones(len(space.cues)), bias)


def _taught(space: Space, teacher: Any, value: Any, action: Action) -> Action:
    """Return a teacher's action; NaN where it is not an action. Raises UserError for another shape."""
    advice = f"give an action of shape {action.shape}, of real numbers"
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise UserError(f"teacher {type(teacher).__name__} gave {format_value(value)}: {advice}") from error
    if array.shape != action.shape:
        raise UserError(f"teacher {type(teacher).__name__} gave an action of shape {array.shape}: {advice}")
    if not jnp.issubdtype(array.dtype, jnp.floating) and not jnp.issubdtype(array.dtype, jnp.integer):
        raise UserError(f"teacher {type(teacher).__name__} gave {array.dtype} numbers: {advice}")
    return space.only_actions(array.astype(action.dtype))


def relative_feedback(
    space: Space, action: Action, best: Action, eps: Number, indifference: Number = 0.0
) -> Float[Array, " cues"]:
    """Return h of each cue in {-1, 0, +1}: the change by -eps, 0 or +eps that brings `action` nearest to `best`.

    0 ("already right") therefore means within eps / 2; `indifference` widens that. Both are in the unit of `space.log`.
    """
    off = space.log(action, best)
    return jnp.where(jnp.abs(off) <= jnp.maximum(eps / 2, indifference), 0.0, jnp.sign(off))


def _answer_by(respond: Callable[..., tuple[Array, Array]]) -> Callable[..., tuple[Array, Array]]:
    """Return a form's `answer`; `respond`: (key, space, action, best with the bias, scalars, *second) -> the same."""

    def answer(key: PRNGKeyArray, env: Any, teacher: Teacher, *question: Any) -> tuple[Array, Array]:
        (state, obs, action, scalars, *second), space = question, actions_of(env)
        best = intended_action(space, teacher, state, obs, action, scalars)
        best = add_bias(space, best, space.from_unit(scalars.teacher_bias_deg))
        return respond(key, space, action, best, scalars, *second)

    return answer


def human_answer(
    key: PRNGKeyArray, space: Space, action: Action, best: Action, scalars: Scalars
) -> tuple[Float[Array, " cues"], Bool[Array, ""]]:
    """Return (h of each cue, answered) of a person with the faults of `scalars` who intends `best`.

    Mistakes and silence are drawn for each cue by itself. `scalars.says` decides which of the cues that people are
    asked about an answer names; h is `UNSAID` for the others. An answer that names no cue counts as not answered.
    """
    mistaken, spoken = _slips(key, scalars, (len(space.cues),))
    eps, indifference = space.from_unit(scalars.eps_deg), space.from_unit(scalars.indifference_deg)
    h = relative_feedback(space, action, best, eps, indifference)
    h = jnp.where(mistaken, -h, h)
    if len(space.cues) == 1:  # with one cue, silence about it is no answer
        return h, spoken[0]
    spoken = spoken & _spoken_of(key, space, space.log(action, best), scalars.says)
    return jnp.where(spoken | ~jnp.isfinite(h), h, UNSAID), spoken.any()


def _spoken_of(key: PRNGKeyArray, space: Space, off: Float[Array, " cues"], says: str) -> Bool[Array, " cues"]:
    """Return which of the cues that people are asked about a teacher names: all, the worst (the first of several), one.

    Cues of one space count in one unit, so the largest difference is also the largest in units of eps.
    """
    numbers = jnp.array([number for number, cue in enumerate(space.cues) if cue.is_asked])
    if says == "worst":
        numbers = numbers[jnp.argmax(jnp.abs(off[numbers]))]
    elif says == "one":
        numbers = numbers[jax.random.randint(jax.random.fold_in(key, len(off)), (), 0, len(numbers))]
    return jnp.isin(jnp.arange(len(off)), numbers)


def demonstrate(
    key: PRNGKeyArray, space: Space, action: Action, best: Action, scalars: Scalars
) -> tuple[Action, Bool[Array, ""]]:
    """Return the action that a teacher with the faults of `scalars` shows, and whether it shows any.

    An indifferent teacher shows the given action where it is near enough. A mistaken teacher changes the action as far
    the other way: the mirror image of the intended action.
    """
    mistaken, answered = _slips(key, scalars)
    right = space.distance(action, best) <= space.from_unit(scalars.indifference_deg)
    return jnp.where(right, action, jnp.where(mistaken, space.exp(action, -space.log(action, best)), best)), answered


def scalar_answer(
    key: PRNGKeyArray, space: Space, action: Action, best: Action, scalars: Scalars
) -> tuple[Float[Array, "1"], Bool[Array, ""]]:
    """Return 1 for a good action and 0 for another, by a teacher with the faults of `scalars`; and whether it answered.

    An action within `scalar_within_deg` of the intended action is good (paper, appendix).
    """
    mistaken, answered = _slips(key, scalars)
    within = jnp.maximum(space.from_unit(scalars.scalar_within_deg), space.from_unit(scalars.indifference_deg))
    good = space.distance(action, best) <= within
    return jnp.where(jnp.isfinite(best).all(), (good != mistaken).astype(jnp.float32), jnp.nan)[None], answered


def draw_second(key: PRNGKeyArray, space: Space, action: Action, scalars: Any) -> Action:
    """Return an action to compare with `action`: far or near, a change of `action` by a scale from eps to the reach.

    The scale's logarithm is uniform, and each cue's change normal. So the first pairs already tell where good actions
    lie, and later ones how near. Without cues the second action is any action.
    """
    if not space.cues:
        return space.sample(jax.random.fold_in(key, SECOND))
    k_scale, k_change = jax.random.split(jax.random.fold_in(key, SECOND))
    eps, reach = space.from_unit(scalars.eps_deg), space.from_unit(space.reach)
    scale = eps * (reach / eps) ** jax.random.uniform(k_scale)
    return space.exp(action, scale * jax.random.normal(k_change, (len(space.cues),)))


def preference(
    key: PRNGKeyArray, space: Space, action: Action, best: Action, scalars: Scalars, second: Action | None = None
) -> tuple[Float[Array, " answer"], Bool[Array, ""]]:
    """Return (choice, *second action) of a teacher with the faults of `scalars`, and whether it answered.

    The better action is the one nearer to the intended action: -1 `action`, 1 the second one. 0 says that there is no
    difference: the two distances differ by eps / 2 at most, or by the indifference where that is larger. `second`: that
    of an earlier question (default: a draw by `key`).

    Source: the teachers of B-Pref (Lee, Smith, Dragan, Abbeel, 2021), which call segments equally preferable, are
    mistaken, or skip a question. A pair here is two single actions in one situation, so no teacher is myopic.
    """
    mistaken, answered = _slips(key, scalars)
    second = draw_second(key, space, action, scalars) if second is None else second
    gain = space.distance(action, best) - space.distance(second, best)
    least = jnp.maximum(space.from_unit(scalars.eps_deg) / 2, space.from_unit(scalars.indifference_deg))
    choice = jnp.where(jnp.abs(gain) <= least, 0.0, jnp.where(mistaken, -1.0, 1.0) * jnp.sign(gain))
    choice = jnp.where(jnp.isfinite(best).all(), choice, jnp.nan)
    return jnp.concatenate([choice[None], second]), answered


def _slips(
    key: PRNGKeyArray, scalars: Scalars, shape: tuple[int, ...] = ()
) -> tuple[Bool[Array, "*shape"], Bool[Array, "*shape"]]:
    """Draw whether the teacher is mistaken, and whether it answers."""
    key_mistake, key_silence = jax.random.split(key)
    mistaken = jax.random.bernoulli(key_mistake, scalars.mistake_probability, shape)
    return mistaken, ~jax.random.bernoulli(key_silence, scalars.silence_probability, shape)


def _way(space: Space) -> str:
    """Return the words for -1 and +1, for a file and for messages."""
    ways = [f"+1 {cue.words[0]}, -1 {cue.words[1]}" if cue.is_asked else "not asked" for cue in space.cues]
    if len(ways) == 1:
        return f"h: {ways[0]}, 0 already right, by eps"
    each = "; ".join(f"{cue.name}: {way}" for cue, way in zip(space.cues, ways, strict=True))
    return f"h of each cue ({each}), 0 already right, {UNSAID:g} not said, by eps"


RELATIVE = AnswerForm(
    name="relative",
    width=lambda space: len(space.cues),
    meaning=_way,
    answer=_answer_by(human_answer),
    values=lambda space: (-1.0, 0.0, 1.0) if len(space.cues) == 1 else (-1.0, 0.0, 1.0, UNSAID),
    by_eps=True,
    correct=lambda space, action, answer, eps: space.toward(action, answer, eps),
)
DEMONSTRATION = AnswerForm(
    name="demonstration",
    width=lambda space: space.size,
    meaning=lambda space: f"what to do instead, an action ({space.name})",
    answer=_answer_by(demonstrate),
    is_action=True,
    correct=lambda space, action, answer, eps: answer,
)
SCALAR = AnswerForm(
    name="scalar",
    width=lambda space: 1,
    meaning=lambda space: "1 a good action, 0 another",
    answer=_answer_by(scalar_answer),
    values=lambda space: (0.0, 1.0),
)
PREFERENCE = AnswerForm(
    name="preference",
    width=lambda space: 1 + space.size,
    meaning=lambda space: "-1 the action is better, 1 a second one, 0 no difference; then the second action",
    answer=_answer_by(preference),
    values=lambda space: (-1.0, 0.0, 1.0),
    second=draw_second,
)
