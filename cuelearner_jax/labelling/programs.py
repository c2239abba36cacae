"""The compiled steps of a session: asking, following, fitting, and what a model would answer itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import asking
from cuelearner_jax.asking import GuideState
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.spaces import UNSAID
from cuelearner_jax.types import EnvState, Label, Teacher

SAME = 1e-5  # by which an observation may differ that is lived through anew

Advance = Callable[[Any, PRNGKeyArray, EnvState, Any], tuple[EnvState, Any]]  # (env, key, state, action)


class Keys(NamedTuple):
    """Random numbers of a session."""

    session: PRNGKeyArray  # of its questions and fits
    model: PRNGKeyArray
    start: PRNGKeyArray  # of the first situation


def keys_of(seed: int) -> Keys:
    """Those of a seed."""
    return Keys(*jax.random.split(jax.random.key(seed), 3))


@jax.jit
def begin(env: Environment, key: PRNGKeyArray) -> tuple[EnvState, jax.Array]:
    """The first situation of an episode: (state, observation)."""
    return env.reset(key)


@jax.jit
def advance(env: Environment, key: PRNGKeyArray, state: EnvState, action: jax.Array) -> tuple[EnvState, jax.Array]:
    """The situation that an action leads to: (state, observation)."""
    after, step = env.step(key, state, action)
    return after, step.obs


def lived(
    env: Environment, keys: Keys, rows: Iterable[tuple[np.ndarray, np.ndarray]]
) -> Iterator[tuple[EnvState, jax.Array]]:
    """Situation after situation: before each of the items, whose observations and actions `rows` hold, and after all.

    Ends early, before the first item that was seen otherwise: by a program of another version.
    """
    state, obs = begin(env, keys.start)
    for number, (seen, action) in enumerate(rows):
        if seen.shape != obs.shape or not np.allclose(np.asarray(obs), seen, atol=SAME):
            return
        yield state, obs
        key = asking.question_keys(keys.session, number).env
        state, obs = advance(env, key, state, jnp.asarray(action))
    yield state, obs


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
    return dataclasses.replace(scalars, answer="best", says="all", **none)


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

    value: float  # share of answers that are equal; of actions the mean distance between them
    count: int
    unit: str  # "%", or the unit of the space

    def __str__(self) -> str:
        if not self.count:
            return "no labels to compare"
        if self.unit == "%":
            return f"{100 * self.value:.0f}% of {self.count}"
        return f"{self.value:.3g} {self.unit} apart over {self.count}"


def agreement(form: AnswerForm, env: Environment, one: np.ndarray, other: np.ndarray) -> Agreement:
    """That of answers (n, width) with others of the same questions; of cues, where both say something."""
    space = actions_of(env)
    if form.is_action:
        apart = np.asarray(space.to_unit(space.distance(jnp.asarray(one), jnp.asarray(other))))
        return Agreement(float(apart.mean()) if len(one) else 0.0, len(one), space.unit)
    alike = one == other
    if form.by_eps and len(space.cues) > 1:
        alike |= (one == UNSAID) | (other == UNSAID)
    return Agreement(float(alike.all(-1).mean()) if len(one) else 0.0, len(one), "%")
