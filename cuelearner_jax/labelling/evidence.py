"""The reading on the labelling page: what the answers so far say, kept up by the learner's thread."""

from __future__ import annotations

import copy
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.environment import actions_of
from cuelearner_jax.labelling.learner import Fitted, Learner
from cuelearner_jax.labelling.programs import Programs
from cuelearner_jax.reading import Reading, Walk
from cuelearner_jax.types import Label


class Theory:
    """What the answers so far say; chooses questions and predicts right actions."""

    def __init__(self, reading: Reading) -> None:
        self._reading = reading

    def question(self, obs: Float[Array, " obs"], key: PRNGKeyArray) -> Float[np.ndarray, " action"]:
        """Return the action to ask about in this situation."""
        return self._reading.questions(np.asarray(obs)[None], 1, key)[1][0]

    def right(self, obs: Float[Array, " obs"]) -> Float[np.ndarray, " action"]:
        """Return the corrected policy's action."""
        return np.asarray(self._reading.act(jnp.asarray(obs)[None]))[0]


def _question(env: Any, scalars: Any, base: Any, guide: Any, keys: Any, bound: Any) -> Any:
    return guide.model.question(guide.obs, keys.question)


def _right(env: Any, scalars: Any, model: Theory, obs: Any, action: Any) -> Any:
    return model.right(obs)


def _no_model(*_: Any) -> Any:
    raise NotImplementedError("a reading fits no model")


PROGRAMS = Programs(question=_question, fit=_no_model, refined=_right, answers=_no_model)


class EvidenceLearner(Learner):
    """Read the answers whenever a full round of labels is new."""

    def prepare(self) -> None:
        """Compile the programs of a question; those of a fit are compiled by the thread."""
        self._reading, self._rows = self._fresh(), []
        self.newest = Fitted(Theory(self._reading))
        walk = Walk(self._env, None, self._plan.config.scalars)  # pyright: ignore[reportArgumentType]  # no teacher
        self.newest.model.question(jnp.asarray(walk.situations(self._key, self._plan.base.policy, 1)[1][0]), self._key)

    def _fresh(self) -> Reading:
        plan = self._plan
        eps, layout = plan.config.scalars.eps_deg, self._env.observation
        return Reading(plan.base.policy, plan.family, actions_of(self._env), eps, plan.labels, layout)

    def fit(self, labels: Label) -> None:
        """Read the new answers; all answers again if earlier ones were taken back."""
        valid = np.flatnonzero(labels.valid)
        obs, action, answer = (np.asarray(part)[valid] for part in (labels.obs, labels.action, labels.answer))
        rows = list(zip(obs, action, answer, strict=True))
        if not rows:
            return
        before = zip(self._rows, rows, strict=False)
        alike = all(np.array_equal(*both) for old, new in before for both in zip(old, new, strict=True))
        # a copy learns, so that questions in the meantime are asked by what was known before
        reading, start = copy.copy(self._reading), len(self._rows)
        if not alike or len(rows) < start:
            reading, start = self._fresh(), 0
        if start == 0:
            reading.read_in_batches(obs, action, answer)
        else:
            reading.learn(obs[start:], action[start:], answer[start:])
        self._reading, self._rows = reading, rows
        told = tuple(reading.result().words())
        self.newest = Fitted(Theory(reading), len(rows), self.newest.number + 1, told=told)
