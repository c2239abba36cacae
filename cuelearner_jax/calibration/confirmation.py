"""Confirmation: answers that tell whether a corrected policy is nearer to what the teacher means.

Where teacher and policy still differ widely after most labels, the model of answers is wrong, and its evidence too
certain. Answers that were not learned then judge without it. An answer that points from the action in question to one
of both policies, and away from the other, is for the first, whatever else is wrong with it. A teacher is asked about
actions halfway between the two, for which every answer is of that sort.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_jax.calibration.meaning import Meaning
from cuelearner_jax.calibration.posterior import Fit
from cuelearner_jax.calibration.questions import Questions
from cuelearner_jax.spaces import is_answered

Floats = np.ndarray
FAR = 2.0  # [eps]: larger typical distance between teacher and corrected policy, after most labels, asks for this
EVERY = 5  # every fifth label is then such an answer
SITUATIONS = 240  # from which these questions are chosen
MOVED = (3.0, 20.0)  # [eps]: distance between both policies in a question, so that neither is right halfway
AGREE = 1.5  # more answers than this must be for the corrected policy, for each one against it


def is_far(fit: Fit) -> bool:
    """Return whether the typical distance between the teacher's actions and the fit's is larger than `FAR`."""
    return fit.noise[1] > FAR


def halfway(
    meaning: Meaning, fit: Fit, obs: Float[Floats, "n obs"], count: int, eps: float, random: np.random.Generator
) -> Questions:
    """Return `count` questions halfway between the policy and the one that the fit corrects, where these differ.

    One question comes from each of `count` equal parts of the situations. Doubts and expected information are zero.
    """
    before, after = _right(meaning, fit, obs)
    offset = meaning.offsets((), np.zeros((1, 0)), after[None], before)[0]
    apart = np.abs(offset).max(-1) / eps
    differs = np.where(apart <= MOVED[1], np.minimum(apart, MOVED[0]), 0) + 1e-3 * random.random(len(obs))
    index = np.array([own[differs[own].argmax()] for own in np.array_split(np.arange(len(obs)), count)])
    action = meaning.moved(before[index], offset[None, index] / 2)[0]
    return Questions(index, action, np.zeros(count), np.zeros(count))


def counts(
    meaning: Meaning,
    fit: Fit,
    obs: Float[Floats, "n obs"],
    action: Float[Floats, "n action"],
    answer: Float[Array | Floats, "n cues"],
) -> tuple[int, int]:
    """Return how many answers about actions are for the corrected policy, and how many against it.

    The paired counts of a sign test (Dixon and Mood, 1946), out of sample where the fit has not learned the answers.
    Answers that point to both policies, or to neither, do not count.
    """
    if not len(obs):
        return 0, 0
    said = np.where(np.asarray(is_answered(jnp.asarray(answer))) & np.isfinite(answer), answer, 0)
    before, after = (said * meaning.offsets((), np.zeros((2, 0)), _right(meaning, fit, obs), action)).sum(-1)
    return int(((after > 0) & (before < 0)).sum()), int(((before > 0) & (after < 0)).sum())


def refuses(confirmed: tuple[int, int]) -> bool:
    """Return whether too few answers are for the corrected policy."""
    return confirmed[0] <= AGREE * confirmed[1]


def _right(meaning: Meaning, fit: Fit, obs: Float[Floats, "n obs"]) -> Float[Floats, "2 n action"]:
    """Return the actions that the teacher would call right without changes, and with them."""
    theta = fit.interval()[0]
    of_teacher = np.concatenate([np.full(len(one.unknowns), one.of_teacher) for one in fit.family])
    thetas = np.stack([np.where(of_teacher, theta, 0), theta])
    return meaning.right(fit.family, thetas, meaning.actions(fit.asks, thetas[:, : fit.changes], obs))
