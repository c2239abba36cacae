"""A session's model: a guide fitted from scratch to all labels so far, or a reading of answers."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import os
import sys
import threading
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_jax import asking
from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.asking import GuideState
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.guides.fitting import held_out
from cuelearner_jax.labelling.plan import SessionKeys, SessionPlan
from cuelearner_jax.reading import Reading
from cuelearner_jax.spaces import UNSAID, Space
from cuelearner_jax.types import EnvState, Label, Teacher

Row = tuple[np.ndarray, np.ndarray, np.ndarray]  # observation, action and answer of a label

# A fit uses one thread, at low priority, so that the page stays responsive.
ALONE = {"xla_cpu_multi_thread_eigen": False}
NICE = 5  # niceness of the fitting thread, of at most 19


class AnswerAgreement(NamedTuple):
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


def agreement(form: AnswerForm, space: Space, one: np.ndarray, other: np.ndarray) -> AnswerAgreement:
    """Compare answers (n, width) to the same questions; a cue counts where both sets say something."""
    if form.is_action:
        values = np.asarray(space.to_unit(space.distance(jnp.asarray(one), jnp.asarray(other))))
    elif form.by_eps and len(space.cues) > 1:
        both = (one != UNSAID) & (other != UNSAID)
        values = ((one == other) | ~both).all(-1)[both.any(-1)]
    else:
        values = (one == other).all(-1)
    unit = space.unit if form.is_action else "%"
    return AnswerAgreement(float(values.mean()) if len(values) else 0.0, len(values), unit)


def as_teacher(
    form: AnswerForm, env: Environment, scalars: Scalars, teacher: Teacher, state: EnvState, *label: Array
) -> Float[Array, " answer"]:
    """Return the answer of a teacher without a simulated one's mistakes, silence, indifference and bias.

    `label`: the question's observation and action, and somebody's answer, which has the second action of a pair.
    """
    obs, action, answer = label
    none = {"mistake_probability": 0.0, "silence_probability": 0.0, "indifference_deg": 0.0, "teacher_bias_deg": 0.0}
    scalars = dataclasses.replace(scalars, answer="best", says="all", **none)
    second = () if form.second is None else (answer[1:],)
    return form.answer(jax.random.key(0), env, teacher, state, obs, action, scalars, *second)[0]


question = jax.jit(asking.question)


@jax.jit
def refine_action(of: asking.Inquiry, model: Any, obs: Array, action: Array) -> Array:
    """Return an action refined by the model (action,)."""
    return of.guidance.act(model, of.env, obs[None], action[None], jnp.ones(1, bool), of.scalars).actions[0]


@jax.jit
def answers(of: asking.Inquiry, model: Any, labels: Label) -> Array:
    """Return the answers that the model predicts (labels, width)."""

    def one(obs: Array, action: Array, answer: Array) -> Array:
        best = refine_action(of, model, obs, action)
        teacher: Any = SimpleNamespace(best_action=lambda state, obs: best)
        return as_teacher(of.guidance.form, of.env, of.scalars, teacher, None, obs, action, answer)  # pyright: ignore[reportArgumentType]

    return jax.vmap(one)(*map(jnp.asarray, (labels.obs, labels.action, labels.answer)))


class Fitted(NamedTuple):
    """A fitted model and its quality."""

    model: Any  # a `GuidanceModel`, or a `Reading`
    labels: int = 0  # number of labels in the fit
    number: int = 0  # of the fit, from 1; 0: no fit yet
    quality: AnswerAgreement | None = None  # with the labels held out of the fit
    problem: str = ""  # why the last fit gave no model (the previous model stays)
    lines: tuple[str, ...] = ()  # reading only: what changed, in words


def step_back() -> None:
    """Lower this thread's priority, where the system has priorities per thread."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)


class Learner:
    """The model of a session's answers: a guide fitted from scratch to all labels, or a reading of new ones."""

    def __init__(self, plan: SessionPlan, env: Any, keys: SessionKeys) -> None:
        slots = asking.label_slots(plan.labels, plan.config.sizes)
        self._blank = asking.start(plan.guidance, env, slots, plan.labels, keys.model, keys.start)
        self._plan, self._key = plan, keys.session
        space, bound = actions_of(env), plan.bound_deg
        within = None if bound is None else space.from_unit(bound)
        self._of = asking.Inquiry(plan.guidance, env, plan.config.scalars, plan.base.policy, within)
        self._reads = plan.guidance.by_evidence
        self._rows: list[np.ndarray] = []  # reading: observations, actions and answers that the newest model has read
        self.newest = Fitted(self._unread() if self._reads else self._blank.model)
        options: Any = ALONE if jax.default_backend() == "cpu" else None
        self._fit = jax.jit(asking.fit, static_argnums=0, compiler_options=options)

    def _unread(self) -> Reading:
        plan, env = self._plan, self._of.env
        eps, bound = plan.config.scalars.eps_deg, np.inf if plan.bound_deg is None else plan.bound_deg
        return Reading(plan.base.policy, plan.family, actions_of(env), eps, plan.labels, env.observation, bound)

    def question(self, guide: GuideState, keys: Any) -> Float[np.ndarray, " action"]:
        """Return the action to ask about in a situation."""
        if self._reads:
            return self.newest.model.questions(np.asarray(guide.obs)[None], 1, keys.question)[1][0]
        return np.asarray(question(self._of, guide.replace(model=self.newest.model), keys)[0])

    def refine(self, obs: Float[Array, " obs"], action: np.ndarray) -> Float[np.ndarray, " action"]:
        """Return an action refined by the newest model; of a reading the corrected policy's action."""
        if self._reads:
            return np.asarray(self.newest.model.act(jnp.asarray(obs)[None]))[0]
        return np.asarray(refine_action(self._of, self.newest.model, obs, jnp.asarray(action)))

    def is_due(self, count: int) -> bool:
        """Return whether a full round of labels is new."""
        every = self._plan.config.sizes.labels_per_round
        return count // every > self.newest.labels // every

    def fit(self, rows: Sequence[Row]) -> None:
        """Fit to these labels, of which no more count than the session wants."""
        if rows := rows[: len(self._blank.labels.valid)]:
            self.newest = self._reading_of(rows) if self._reads else self._model_of(rows)

    def _model_of(self, rows: Sequence[Row]) -> Fitted:
        of, plan, count = self._of, self._plan, len(rows)
        labels = jax.tree.map(np.array, self._blank.labels)
        for slot, (obs, action, answer) in enumerate(rows):
            labels.obs[slot], labels.action[slot], labels.answer[slot], labels.valid[slot] = obs, action, answer, True
        guide = self._blank.replace(labels=jax.tree.map(jnp.asarray, labels))
        rounds = jnp.asarray(count // plan.config.sizes.labels_per_round, jnp.int32)
        model = jax.block_until_ready(self._fit(of.guidance, of.env, of.scalars, guide, self._key, rounds).model)
        if not all_finite(model):
            return self.newest._replace(labels=count, problem="the last fit diverged")
        apart = labels.valid & held_out(len(labels.valid)) & of.guidance.holds_out
        predicted = np.asarray(answers(of, model, labels))[apart]
        quality = agreement(plan.form, actions_of(of.env), predicted, labels.answer[apart])
        return Fitted(model, count, self.newest.number + 1, quality if quality.count else None)

    def _reading_of(self, rows: Sequence[Row]) -> Fitted:
        """Read what is new in `rows`; all of it again if earlier answers were taken back."""
        columns = [np.stack(part) for part in zip(*rows, strict=True)]
        count = len(self._rows[0]) if self._rows else 0
        if count and all(np.array_equal(old, new[:count]) for old, new in zip(self._rows, columns, strict=True)):
            # a copy learns, so that questions in the meantime are asked by what was known before
            reading = copy.copy(self.newest.model)
            reading.learn(*(column[count:] for column in columns))
        else:
            reading = self._unread()
            reading.read_in_batches(*columns)
        self._rows = columns
        return Fitted(reading, len(rows), self.newest.number + 1, lines=tuple(reading.result().words()))
