"""A session's model, fitted in the background: a guide from scratch to all labels so far, or a reading of answers."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import asking
from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.asking import GuideState
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.fitting import held_out
from cuelearner_jax.labelling.plan import Plan
from cuelearner_jax.reading import Reading, Walk
from cuelearner_jax.spaces import UNSAID
from cuelearner_jax.types import EnvState, Label, Teacher

# A fit uses one thread, at low priority, so that the page stays responsive.
ALONE = {"xla_cpu_multi_thread_eigen": False}
NICE = 5  # niceness of the fitting thread, of at most 19


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


def as_teacher(
    form: AnswerForm, env: Environment, scalars: Scalars, teacher: Teacher, state: EnvState, obs: Array, action: Array
) -> Float[Array, " answer"]:
    """Return the answer of a teacher without a simulated one's mistakes, silence, indifference and bias."""
    none = {"mistake_probability": 0.0, "silence_probability": 0.0, "indifference_deg": 0.0, "teacher_bias_deg": 0.0}
    scalars = dataclasses.replace(scalars, answer="best", says="all", **none)
    return form.answer(jax.random.key(0), env, teacher, state, obs, action, scalars)[0]


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

    def one(obs: Array, action: Array) -> Array:
        best = refined(guidance, env, scalars, model, obs, action)
        teacher: Any = SimpleNamespace(best_action=lambda state, obs: best)
        return as_teacher(guidance.form, env, scalars, teacher, None, obs, action)  # pyright: ignore[reportArgumentType]

    return jax.vmap(one)(jnp.asarray(labels.obs), jnp.asarray(labels.action))


class Fitted(NamedTuple):
    """A fitted model and its quality."""

    model: Any  # a `GuidanceModel`, or a `Reading`
    labels: int = 0  # number of labels in the fit
    number: int = 0  # of the fit, from 1; 0: no fit yet
    quality: Agreement | None = None  # with the labels held out of the fit
    problem: str = ""  # why the last fit gave no model (the previous model stays)
    lines: tuple[str, ...] = ()  # reading only: what changed, in words


def _step_back() -> None:
    """Lower this thread's priority, where the system has priorities per thread."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)


class Learner:
    """Fit whenever a full round of labels is new, one fit at a time."""

    def __init__(self, plan: Plan, env: Any, blank: GuideState, key: PRNGKeyArray) -> None:
        """Begin to compile the fit; `blank` is a guide without labels, `key` the session's."""
        self._plan, self._env, self._blank, self._key = plan, env, blank, key
        self.newest = Fitted(blank.model)
        self.running = False
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="fit", initializer=_step_back)
        self.prepare()

    def prepare(self) -> None:
        """Begin to compile the fit, for which the first question need not wait."""
        bound = self._plan.bound_deg
        self._bound = None if bound is None else actions_of(self._env).from_unit(bound)
        self._fit = self._pool.submit(self._compiled)

    def _compiled(self) -> Any:
        options: Any = ALONE if jax.default_backend() == "cpu" else None
        arguments = self._arguments(self._blank.labels, 0)
        return fit.lower(self._plan.guidance, *arguments).compile(compiler_options=options)

    def _arguments(self, labels: Label, count: int) -> tuple[Any, ...]:
        guide = self._blank.replace(labels=jax.tree.map(jnp.asarray, labels), model=self.newest.model)
        rounds = jnp.asarray(count // self._plan.config.sizes.labels_per_round, jnp.int32)
        return self._env, self._plan.config.scalars, guide, self._key, rounds

    def question(self, guide: GuideState, keys: Any) -> Float[np.ndarray, " action"]:
        """Return the action to ask about in a situation."""
        plan, guide = self._plan, guide.replace(model=self.newest.model)
        asked = plan.guidance, self._env, plan.config.scalars, plan.base.policy, guide, keys, self._bound
        return np.asarray(question(*asked))

    def refined(self, obs: Float[Array, " obs"], action: np.ndarray) -> Float[np.ndarray, " action"]:
        """Return an action refined by the newest model."""
        model, scalars = self.newest.model, self._plan.config.scalars
        return np.asarray(refined(self._plan.guidance, self._env, scalars, model, obs, jnp.asarray(action)))

    def padded(self, rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Label:
        """Put observations, actions and answers into a padded `Label` of the session's size."""
        blank = jax.tree.map(np.array, self._blank.labels)
        for slot, (obs, action, answer) in enumerate(rows[: len(blank.valid)]):
            blank.obs[slot], blank.action[slot], blank.answer[slot], blank.valid[slot] = obs, action, answer, True
        return blank

    def fit(self, labels: Label) -> None:
        """Fit to these labels now; return when the fit is done."""
        if not (count := int(labels.valid.sum())):
            return
        plan = self._plan
        model = jax.block_until_ready(self._fit.result()(*self._arguments(labels, count)).model)
        if not all_finite(model):
            self.newest = self.newest._replace(labels=count, problem="the last fit diverged")
            return
        predicted = np.asarray(answers(plan.guidance, self._env, plan.config.scalars, model, labels))
        apart = np.asarray(labels.valid) & held_out(len(labels.valid))
        quality = agreement(plan.form, self._env, predicted[apart], np.asarray(labels.answer)[apart])
        self.newest = Fitted(model, count, self.newest.number + 1, quality if quality.count else None)

    def fit_later(self, labels: Callable[[], Label], count: int, done: Callable[[], None]) -> bool:
        """Start a background fit if due; return whether one started.

        The thread fits to what `labels` then returns, and calls `done` afterwards.
        """
        every = self._plan.config.sizes.labels_per_round
        with self._lock:
            if self.running or count // every <= self.newest.labels // every:
                return False
            self.running = True

        def work() -> None:
            try:
                self.fit(labels())
            except Exception as error:  # labels are still saved, whatever happens to the model
                problem = f"the last fit failed ({type(error).__name__}: {error})"
                self.newest = self.newest._replace(labels=count, problem=problem)
            finally:
                with self._lock:
                    self.running = False
            done()

        self._pool.submit(work)
        return True

    def close(self) -> None:
        """Wait for a running fit, then stop the thread."""
        self._pool.shutdown(wait=True, cancel_futures=True)


class EvidenceLearner(Learner):
    """Read the answers whenever a full round of labels is new; the model is a `Reading`."""

    def prepare(self) -> None:
        """Compile the programs of a question; those of a fit are compiled by the thread."""
        self._rows: list[tuple[np.ndarray, ...]] = []
        self.newest = Fitted(self._fresh())
        walk = Walk(self._env, None, self._plan.config.scalars)  # pyright: ignore[reportArgumentType]  # no teacher
        obs = np.asarray(walk.situations(self._key, self._plan.base.policy, 1)[1])
        self.newest.model.questions(obs[:1], 1, self._key)

    def _fresh(self) -> Reading:
        plan, eps = self._plan, self._plan.config.scalars.eps_deg
        space, layout = actions_of(self._env), self._env.observation
        return Reading(plan.base.policy, plan.family, space, eps, plan.labels, layout)

    def question(self, guide: GuideState, keys: Any) -> Float[np.ndarray, " action"]:
        """Return the action to ask about in a situation."""
        return self.newest.model.questions(np.asarray(guide.obs)[None], 1, keys.question)[1][0]

    def refined(self, obs: Float[Array, " obs"], action: np.ndarray) -> Float[np.ndarray, " action"]:
        """Return the corrected policy's action."""
        return np.asarray(self.newest.model.act(jnp.asarray(obs)[None]))[0]

    def fit(self, labels: Label) -> None:
        """Read the new answers; all answers again if earlier ones were taken back."""
        valid = np.flatnonzero(labels.valid)
        columns = [np.asarray(part)[valid] for part in (labels.obs, labels.action, labels.answer)]
        before, rows = self._rows, list(zip(*columns, strict=True))
        if not rows:
            return
        both = zip(before, rows, strict=False)
        alike = all(np.array_equal(*pair) for old, new in both for pair in zip(old, new, strict=True))
        if before and alike and len(rows) >= len(before):
            # a copy learns, so that questions in the meantime are asked by what was known before
            reading = copy.copy(self.newest.model)
            reading.learn(*(column[len(before) :] for column in columns))
        else:
            reading = self._fresh()
            reading.read_in_batches(*columns)
        self._rows = rows
        self.newest = Fitted(reading, len(rows), self.newest.number + 1, lines=tuple(reading.result().words()))
