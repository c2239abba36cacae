"""The reading on the labelling page: what the answers so far say, kept up by the learner's thread."""

from __future__ import annotations

import copy
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_jax.asking import GuideState
from cuelearner_jax.environment import actions_of
from cuelearner_jax.labelling.learner import Fitted, Learner
from cuelearner_jax.reading import Reading, Walk
from cuelearner_jax.types import Label


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
        plan = self._plan
        eps, layout = plan.config.scalars.eps_deg, self._env.observation
        return Reading(plan.base.policy, plan.family, actions_of(self._env), eps, plan.labels, layout)

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
        rows = list(zip(*columns, strict=True))
        if not rows:
            return
        before = zip(self._rows, rows, strict=False)
        alike = all(np.array_equal(*both) for old, new in before for both in zip(old, new, strict=True))
        if self._rows and alike and len(rows) >= len(self._rows):
            # a copy learns, so that questions in the meantime are asked by what was known before
            reading = copy.copy(self.newest.model)
            reading.learn(*(column[len(self._rows) :] for column in columns))
        else:
            reading = self._fresh()
            reading.read_in_batches(*columns)
        self._rows = rows
        self.newest = Fitted(reading, len(rows), self.newest.number + 1, told=tuple(reading.result().words()))
