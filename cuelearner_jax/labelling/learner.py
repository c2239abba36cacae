"""Background fitting of a session's model: from scratch, to all labels so far, in a thread of its own."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.asking import GuideState
from cuelearner_jax.environment import actions_of
from cuelearner_jax.guides.fitting import held_out
from cuelearner_jax.labelling import programs
from cuelearner_jax.labelling.plan import Plan
from cuelearner_jax.labelling.programs import Agreement, agreement
from cuelearner_jax.types import Label

# A fit uses one thread, at low priority, so that the page stays responsive.
ALONE = {"xla_cpu_multi_thread_eigen": False}
NICE = 5  # niceness of the fitting thread, of at most 19


def _step_back() -> None:
    """Lower this thread's priority, where the system has priorities per thread."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)


class Fitted(NamedTuple):
    """A fitted model and its quality."""

    model: Any  # a `GuidanceModel`, or a `Reading`
    labels: int = 0  # number of labels in the fit
    number: int = 0  # of the fit, from 1; 0: no fit yet
    quality: Agreement | None = None  # with the labels held out of the fit
    problem: str = ""  # why the last fit gave no model (the previous model stays)
    told: tuple[str, ...] = ()  # reading only: lines that report what changed


class Learner:
    """Fit whenever a full round of labels is new, one fit at a time."""

    def __init__(self, plan: Plan, env: Any, blank: GuideState, key: PRNGKeyArray) -> None:
        """Begins to compile the fit; `blank` is a guide that knows nothing, `key` the session's."""
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
        given = self._env, self._plan.config.scalars, *self._given(self._blank.labels, 0)
        lowered = programs.fit.lower(self._plan.guidance, *given)
        options: Any = ALONE if jax.default_backend() == "cpu" else None
        return lowered.compile(compiler_options=options)

    def _given(self, labels: Label, count: int) -> tuple[GuideState, PRNGKeyArray, jax.Array]:
        guide = self._blank.replace(labels=jax.tree.map(jnp.asarray, labels), model=self.newest.model)
        return guide, self._key, jnp.asarray(count // self._plan.config.sizes.labels_per_round, jnp.int32)

    def question(self, guide: GuideState, keys: Any) -> Float[np.ndarray, " action"]:
        """Return the action to ask about in a situation."""
        plan, guide = self._plan, guide.replace(model=self.newest.model)
        given = plan.guidance, self._env, plan.config.scalars, plan.base.policy, guide, keys, self._bound
        return np.asarray(programs.question(*given))

    def refined(self, obs: Float[Array, " obs"], action: np.ndarray) -> Float[np.ndarray, " action"]:
        """Return an action refined by the newest model."""
        model, scalars = self.newest.model, self._plan.config.scalars
        return np.asarray(programs.refined(self._plan.guidance, self._env, scalars, model, obs, jnp.asarray(action)))

    def padded(self, rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Label:
        """Put observations, actions and answers into a padded `Label` of the session's size."""
        blank = jax.tree.map(np.array, self._blank.labels)
        for slot, (obs, action, answer) in enumerate(rows[: len(blank.valid)]):
            blank.obs[slot], blank.action[slot], blank.answer[slot], blank.valid[slot] = obs, action, answer, True
        return blank

    def fit(self, labels: Label) -> None:
        """Fit to these labels now; return when the fit is done."""
        count = int(labels.valid.sum())
        if not count:
            return
        scalars = self._plan.config.scalars
        model = jax.block_until_ready(self._fit.result()(self._env, scalars, *self._given(labels, count)).model)
        if not all_finite(model):
            self.newest = self.newest._replace(labels=count, problem="the last fit diverged")
            return
        would = np.asarray(programs.answers(self._plan.guidance, self._env, scalars, model, labels))
        kept = np.asarray(labels.valid) & held_out(len(labels.valid))
        found = agreement(self._plan.form, self._env, would[kept], np.asarray(labels.answer)[kept])
        self.newest = Fitted(model, count, self.newest.number + 1, found if found.count else None)

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
