"""The compiled steps of a labelling session: choose a question, step the world, fit, and predict answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import asking
from cuelearner_jax.asking import GuideState
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.spaces import UNSAID
from cuelearner_jax.types import EnvState, Label, Teacher

SAME = 1e-5  # largest difference of a replayed observation from the recorded one

Advance = Callable[[Any, PRNGKeyArray, EnvState, Any], tuple[EnvState, Any]]  # (env, key, state, action)


class Keys(NamedTuple):
    """Random keys of a session."""

    session: PRNGKeyArray  # for questions and fits
    model: PRNGKeyArray
    start: PRNGKeyArray  # for the first situation


def keys_of(seed: int) -> Keys:
    """Derive a session's random keys from its seed."""
    return Keys(*jax.random.split(jax.random.key(seed), 3))


@jax.jit
def begin(env: Environment, key: PRNGKeyArray) -> tuple[EnvState, jax.Array]:
    """Return the first situation of an episode: (state, observation)."""
    return env.reset(key)


@jax.jit
def advance(env: Environment, key: PRNGKeyArray, state: EnvState, action: jax.Array) -> tuple[EnvState, jax.Array]:
    """Return the situation after an action: (state, observation)."""
    after, step = env.step(key, state, action)
    return after, step.obs


def lived(
    env: Environment, keys: Keys, rows: Iterable[tuple[np.ndarray, np.ndarray]]
) -> Iterator[tuple[EnvState, jax.Array]]:
    """Replay recorded items; yield the situation (state, observation) before each item, and after the last.

    `rows` holds the items' observations and actions. The replay ends early, before the first item whose observation
    differs from the recorded one (a program of another version).
    """
    state, obs = begin(env, keys.start)
    for number, (seen, action) in enumerate(rows):
        if seen.shape != obs.shape or not np.allclose(np.asarray(obs), seen, atol=SAME):
            return
        yield state, obs
        key = asking.question_keys(keys.session, number).env
        state, obs = advance(env, key, state, jnp.asarray(action))
    yield state, obs


fit = jax.jit(asking.fit, static_argnums=0)  # (guidance, env, scalars, guide, lane_key, times) -> guide with a model


@partial(jax.jit, static_argnums=0)
def question(guidance: Guide, env: Any, scalars: Scalars, base: Any, guide: GuideState, keys: Any, bound: Any) -> Array:
    """Return the action to ask about (action,)."""
    return asking.question(asking.Inquiry(guidance, env, scalars, base, bound), guide, keys)[0]


@partial(jax.jit, static_argnums=0)
def refined(guidance: Guide, env: Any, scalars: Scalars, model: Any, obs: Array, action: Array) -> Array:
    """Return an action refined by the model (action,)."""
    return guidance.act(model, env, obs[None], action[None], jnp.ones(1, bool), scalars).actions[0]


@partial(jax.jit, static_argnums=0)
def answers(guidance: Guide, env: Any, scalars: Scalars, model: Any, labels: Label) -> Array:
    """Return the answers that the model predicts (labels, width)."""
    form = guidance.form
    assert form is not None

    def one(obs: Array, action: Array) -> Array:
        best = _Holds(refined(guidance, env, scalars, model, obs, action))
        return as_teacher(form, env, scalars, best, None, obs, action)  # pyright: ignore[reportArgumentType]

    return jax.vmap(one)(jnp.asarray(labels.obs), jnp.asarray(labels.action))


class _Holds(NamedTuple):
    """A teacher with one fixed best action."""

    action: Array

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the fixed action (action,)."""
        return self.action


def as_teacher(
    form: AnswerForm,
    env: Environment,
    scalars: Scalars,
    teacher: Teacher,
    state: EnvState,
    obs: Float[Array, " obs"],
    action: Float[Array, " action"],
) -> Float[Array, " answer"]:
    """Return the answer of a teacher without a simulated one's mistakes, silence, indifference and bias."""
    none = {"mistake_probability": 0.0, "silence_probability": 0.0, "indifference_deg": 0.0, "teacher_bias_deg": 0.0}
    scalars = dataclasses.replace(scalars, answer="best", says="all", **none)
    return form.answer(jax.random.key(0), env, teacher, state, obs, action, scalars)[0]


class Agreement(NamedTuple):
    """Agreement of two sets of answers."""

    value: float  # share of equal answers; for actions, the mean distance between them
    count: int
    unit: str  # "%", or the unit of the space

    def __str__(self) -> str:
        if not self.count:
            return "no labels to compare"
        if self.unit == "%":
            return f"{100 * self.value:.0f}% of {self.count}"
        return f"{self.value:.3g} {self.unit} apart over {self.count}"


def agreement(form: AnswerForm, env: Environment, one: np.ndarray, other: np.ndarray) -> Agreement:
    """Compare answers (n, width) to the same questions; a cue counts where both sets say something."""
    space = actions_of(env)
    if form.is_action:
        values = np.asarray(space.to_unit(space.distance(jnp.asarray(one), jnp.asarray(other))))
    else:
        alike = one == other
        if form.by_eps and len(space.cues) > 1:
            alike |= (one == UNSAID) | (other == UNSAID)
        values = alike.all(-1)
    return Agreement(float(values.mean()) if len(one) else 0.0, len(one), space.unit if form.is_action else "%")
