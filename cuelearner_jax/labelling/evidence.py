"""Calibration on the labelling page: answers as evidence of what changed, processed by the learner's thread.

The learner updates its own calibration. Questions are chosen by a frozen copy of that calibration.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.adaptation.by_calibration import LEAST
from cuelearner_jax.calibration import CHANGED, UNEXPLAINED, Calibrated, Calibration, Result, Walk
from cuelearner_jax.calibration.families import Family, unknowns_of
from cuelearner_jax.calibration.meaning import is_python
from cuelearner_jax.calibration.questions import ties
from cuelearner_jax.environment import actions_of
from cuelearner_jax.labelling.learner import Fitted, Learner
from cuelearner_jax.labelling.programs import Programs
from cuelearner_jax.types import Label

SOUND = 40  # labels before the page reports that no change explains the answers; with fewer, this verdict is unreliable
BESIDE = 7  # other situations, which set the scale of each unknown and of the small changes in a question


@jax.jit
def _act(policy: Any, obs: Array) -> Array:
    return policy.act(jax.random.key(0), None, obs)


class Theory:
    """Calibration's inference from the answers so far; chooses questions and predicts right actions."""

    def __init__(self, known: Calibration, family: Family, beside: Float[np.ndarray, "n obs"]) -> None:
        self.known, self.beside = known, beside
        policy, names = known.policy(), [one.name for one in unknowns_of(family)]
        theta = dict.fromkeys(names, 0.0)
        if isinstance(policy, Calibrated) and policy is not known.base:
            own = [one.name for one in unknowns_of(policy.family)]
            theta |= dict(zip(own, np.asarray(policy.theta).tolist(), strict=True))
        # The policy covers the whole family, whatever has changed so far, so that it compiles once.
        self.policy = Calibrated(known.base, jnp.array([theta[name] for name in names]), family)

    def question(self, obs: Float[Array, " obs"], key: PRNGKeyArray) -> Float[np.ndarray, " action"]:
        """Return the action in this situation whose answer is expected to be most informative."""
        known = self.known.copy(np.random.default_rng(np.asarray(jax.random.key_data(key))))
        rows = np.concatenate([np.asarray(obs)[None], self.beside])
        return known.questions(rows, len(rows)).action[0]

    def right(self, obs: Float[Array, " obs"]) -> Float[np.ndarray, " action"]:
        """Return the corrected policy's action."""
        rows = jnp.asarray(obs)[None]
        found = self.policy.act(jax.random.key(0), None, rows) if is_python(self.policy) else _act(self.policy, rows)
        return np.asarray(found)[0]


def _question(env: Any, scalars: Any, base: Any, guide: Any, keys: Any, bound: Any) -> Any:
    return guide.model.question(guide.obs, keys.question)


def _right(env: Any, scalars: Any, model: Theory, obs: Any, action: Any) -> Any:
    return model.right(obs)


def _no_model(*_: Any) -> Any:
    raise NotImplementedError("calibration fits no model")


PROGRAMS = Programs(question=_question, fit=_no_model, refined=_right, answers=_no_model)


class EvidenceLearner(Learner):
    """Update the calibration whenever a full round of labels is new."""

    def prepare(self) -> None:
        """Meet some situations and compile the choice of questions."""
        plan, env = self._plan, self._env
        walk = Walk(env, None, plan.config.scalars)  # pyright: ignore[reportArgumentType]  # no teacher is needed
        self._beside = np.asarray(walk.situations(self._key, plan.base.policy, BESIDE)[1], np.float32)
        self._rows: list[tuple[np.ndarray, ...]] = []
        self._known = self._fresh()
        self._known.questions(self._beside, 1)  # fixes the range of the unknowns
        self.newest = Fitted(self._theory())
        self.newest.model.right(jnp.asarray(self._beside[0]))

    def _fresh(self) -> Calibration:
        plan = self._plan
        return Calibration(plan.base.policy, plan.family, actions_of(self._env), plan.config.scalars.eps_deg, plan.seed)

    def _theory(self) -> Theory:
        family = tuple(one for one in self._plan.family if not one.of_teacher)
        return Theory(self._known.copy(self._known.random), family, self._beside)

    def fit(self, labels: Label) -> None:
        """Process the new labels; all labels again if earlier ones were taken back."""
        valid = np.flatnonzero(labels.valid)
        obs, action, answer = (np.asarray(part)[valid] for part in (labels.obs, labels.action, labels.answer))
        rows = list(zip(obs, action, answer, strict=True))
        if not rows:
            return
        before = zip(self._rows, rows, strict=False)
        alike = all(np.array_equal(*both) for old, new in before for both in zip(old, new, strict=True))
        if not alike or len(rows) < len(self._rows):
            scales, self._known, self._rows = self._known.scales, self._fresh(), []
            self._known.scales = scales
        if new := rows[len(self._rows) :]:
            obs, action, answer = (part[-len(new) :] for part in (obs, action, answer))
            beside = np.concatenate([obs, self._beside])
            doubt = ties(self._known.meaning, (), np.zeros(0), beside, self._known.eps)[: len(obs)]
            self._known.learn(obs, action, answer, doubt)
            self._rows, self._known.confirmed = rows, None
            if len(rows) >= SOUND and self._known.is_far:
                self._known.cross_confirm()
        told = describe_result(self._known.result(), len(rows)) if len(rows) >= LEAST else ()
        self.newest = Fitted(self._theory(), len(rows), self.newest.number + 1, told=told)


def describe_result(result: Result, labels: int) -> tuple[str, ...]:
    """Return lines that report what the answers so far show."""
    if result.verdict == CHANGED or result.refused:
        return tuple(result.words())
    if result.verdict == UNEXPLAINED and labels >= SOUND:
        return ("none of these changes explains the answers",)
    return ("no change seen yet",)
