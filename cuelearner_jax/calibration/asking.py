"""Calibration by a teacher who is asked, in batches of which the last confirms; or by answers that are given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.calibration import confirmation
from cuelearner_jax.calibration.estimation import BATCH, Calibration
from cuelearner_jax.calibration.families import Distortion
from cuelearner_jax.calibration.result import Result
from cuelearner_jax.spaces import Space

CHOICE = 6  # situations from which one question is chosen

Situations = Callable[[PRNGKeyArray, Any, int], tuple[Any, Any]]  # (key, policy, count) -> states, observations
Asked = Callable[[PRNGKeyArray, Any, Any, Any], Any]  # (key, states, observations, actions) -> answers (n, cues)


def calibrate(
    policy: Any,
    family: Sequence[Distortion],
    situations: Situations,
    teacher: Asked,
    labels: int,
    key: PRNGKeyArray,
    *,
    space: Space,
    eps_deg: float,
) -> Result:
    """Ask a teacher in batches and estimate the changes. No reward is used.

    Held-out answers judge. Where teacher and policy differ widely, the last fifth of the labels asks whether the
    corrected policy is nearer to what the teacher means: model-free, so that it holds where no change of the family
    describes the answers.

    Args:
        policy: a policy, or any function of a batch of observations.
        family: the possible changes.
        situations: gives states and observations (count, obs) that a policy meets.
        teacher: gives answers (n, cues), -1, 0, 1 or `UNSAID`; NaN where it did not answer.
        labels: number of questions.
        key: key of all random numbers.
        space: space of the actions.
        eps_deg: strength of an answer, in the space's unit.

    Raises:
        UserError: settings that make no sense, or too few labels.
    """
    k_seed, key = jax.random.split(key)
    calibration = Calibration(policy, family, space, eps_deg, int(jax.random.randint(k_seed, (), 0, 1 << 20)))
    left, last = labels, labels // confirmation.EVERY
    while left:
        k_where, k_answer, key = jax.random.split(key, 3)
        confirms = left == last and calibration.is_far
        count = last if confirms else min(BATCH, left - last if left > last else left)
        ask, learn, met = calibration.questions, calibration.learn, CHOICE * count
        if confirms:  # another number of situations makes a `Walk` start new environments
            ask, learn = calibration.confirmations, calibration.confirm
            met = max(confirmation.SITUATIONS, met)
        states, obs = situations(k_where, calibration.policy(), met)
        asked = ask(np.asarray(obs), count)
        states = _rows(states, asked.index)
        obs = np.asarray(obs)[asked.index]
        answers = np.asarray(teacher(k_answer, states, jnp.asarray(obs), jnp.asarray(asked.action)))
        there = np.isfinite(answers).any(-1)
        learn(obs[there], asked.action[there], answers[there], asked.doubt[there])
        left -= count
    return calibration.result()


@jax.jit
def _rows(states: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], states)


def read_answers(
    policy: Any,
    family: Sequence[Distortion],
    obs: Float[Array | np.ndarray, "n obs"],
    action: Float[Array | np.ndarray, "n action"],
    answer: Float[Array | np.ndarray, "n cues"],
    *,
    space: Space,
    eps_deg: float,
    seed: int = 0,
) -> Result:
    """Estimate the changes from answers that are there already: those of a file, or of the labelling page.

    Where teacher and policy differ widely, each fifth of the answers judges changes that are fitted to the others.

    Args:
        policy, family, space, eps_deg: as for `calibrate`.
        obs, action, answer: situations, the actions in question, and answers -1, 0, 1 or `UNSAID`.
        seed: seed of all random numbers.

    Raises:
        UserError: settings that make no sense, or too few answers.
    """
    calibration = Calibration(policy, family, space, eps_deg, seed)
    # In instalments, each of which asks the policy again near the changes that are likely by then.
    size, read = BATCH, 0
    while read < len(obs):
        part = slice(read, read + max(size, read // 2))
        calibration.learn(obs[part], action[part], answer[part])
        read = part.stop
    if calibration.is_far:
        calibration.cross_confirm()
    return calibration.result()
