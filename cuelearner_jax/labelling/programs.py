"""The compiled steps of a session: asking, following, fitting, and what a model would answer itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_jax import asking
from cuelearner_jax.asking import GuideState
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.types import EnvState, Label, Teacher


class Programs(NamedTuple):
    """Compiled functions of one form of guidance; each is called with arrays of the same shapes throughout."""

    question: Callable[..., Array]  # (env, scalars, base, guide, keys, bound) -> the action to ask about (action,)
    fit: Callable[..., GuideState]  # (env, scalars, guide, lane_key, times) -> with a model of its labels
    refined: Callable[..., Array]  # (env, scalars, model, obs, action) -> what the model makes of an action (action,)
    answers: Callable[..., Array]  # (env, scalars, model, labels) -> what it would have answered (labels, width)


@cache
def programs(guidance: Guide) -> Programs:
    """Those of a guidance, not compiled yet; the same ones for the same guidance."""

    def refined(env: Any, scalars: Any, model: Any, obs: Array, action: Array) -> Array:
        return guidance.act(model, env, obs[None], action[None], jnp.ones(1, bool), scalars).actions[0]

    def answers(env: Any, scalars: Scalars, model: Any, labels: Label) -> Array:
        assert guidance.form is not None

        def one(obs: Array, action: Array) -> Array:
            best = refined(env, scalars, model, obs, action)
            return as_teacher(guidance.form, env, scalars, _Holds(best), None, obs, action)  # pyright: ignore[reportArgumentType]

        return jax.vmap(one)(jnp.asarray(labels.obs), jnp.asarray(labels.action))

    def question(env: Any, scalars: Any, base: Any, guide: Any, keys: Any, bound: Any) -> Array:
        return asking.question(asking.Inquiry(guidance, env, scalars, base, bound), guide, keys)[0]

    return Programs(
        question=jax.jit(question),
        fit=jax.jit(partial(asking.fit, guidance)),
        refined=jax.jit(refined),
        answers=jax.jit(answers),
    )


class _Holds:
    """A teacher that holds one action for best."""

    def __init__(self, action: Array) -> None:
        self.action = action

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """That action."""
        return self.action


def faultless(scalars: Scalars) -> Scalars:
    """The same without the faults of a simulated teacher, who looks at one action alone."""
    none = {"mistake_probability": 0.0, "silence_probability": 0.0, "indifference_deg": 0.0, "teacher_bias_deg": 0.0}
    return dataclasses.replace(scalars, answer="best", **none)


def as_teacher(
    form: AnswerForm,
    env: Environment,
    scalars: Scalars,
    teacher: Teacher,
    state: EnvState,
    obs: Float[Array, " obs"],
    action: Float[Array, " action"],
) -> Float[Array, " answer"]:
    """What a teacher without faults answers."""
    return form.answer(jax.random.key(0), env, teacher, state, obs, action, faultless(scalars))[0]


class Agreement(NamedTuple):
    """How well two sets of answers agree."""

    value: float  # share of answers that are equal; of actions the mean angle between them [deg]
    count: int
    unit: str  # "%" or "deg"

    def __str__(self) -> str:
        if not self.count:
            return "no labels to compare"
        amount = f"{100 * self.value:.0f}%" if self.unit == "%" else f"{self.value:.1f} degrees apart"
        return f"{amount} of {self.count}" if self.unit == "%" else f"{amount} over {self.count}"


def agreement(form: AnswerForm, env: Environment, one: np.ndarray, other: np.ndarray) -> Agreement:
    """That of answers (n, width) with others of the same questions."""
    if form.is_action:
        apart = np.asarray(actions_of(env).distance(jnp.asarray(one), jnp.asarray(other)))
        return Agreement(float(np.degrees(apart).mean()) if len(one) else 0.0, len(one), "deg")
    return Agreement(float((one == other).all(-1).mean()) if len(one) else 0.0, len(one), "%")
