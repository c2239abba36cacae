"""Choose the actions whose answers are expected to tell most about the changes, away from the policy's ties."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from cuelearner_jax.calibration.families import Family
from cuelearner_jax.calibration.likelihood import chances
from cuelearner_jax.calibration.meaning import Meaning
from cuelearner_jax.calibration.posterior import Fit
from cuelearner_jax.calibration.response import Response

Floats = np.ndarray
ANSWERS = (-1.0, 0.0, 1.0)
DRAWS = 24  # draws of the unknowns
NUDGES, NUDGE = 4, 1e-3  # tiny changes of an observation, as a share of how much its entries differ
# offsets of an asked action, in spreads of the possibly meant actions
TURNS = np.array([-2.0, -1.3, -0.8, -0.4, 0.0, 0.4, 0.8, 1.3, 2.0])
LEAST_SPREAD = 0.75  # [eps]
WIDEST = 5.0  # [eps]: beyond, a teacher may mean another action


class Questions(NamedTuple):
    """Actions to ask about."""

    index: Int[np.ndarray, " questions"]  # number of the situation
    action: Float[Floats, "questions action"]
    doubt: Float[Floats, " questions"]  # see `ties`
    information: Float[Floats, " questions"]  # expected information of the answer [nats]


def ties(
    meaning: Meaning, family: Family, theta: Float[Floats, " unknowns"], obs: Float[Floats, "n obs"], eps: float
) -> Float[Floats, " n"]:
    """Return the share of tiny changes of each observation that make the policy choose another action.

    There the policy is at a tie of two actions, and an answer about one of them tells nothing about the unknowns.
    """
    random = np.random.default_rng(0)
    size = NUDGE * obs.std(0)
    nudged = [obs, *(obs + size * random.standard_normal(obs.shape) for _ in range(NUDGES))]
    found = meaning.actions(family, theta[None], np.concatenate(nudged).astype(np.float32))[0]
    found = found.reshape(1 + NUDGES, len(obs), -1)
    nothing = np.zeros((NUDGES, 0))
    moved = meaning.offsets((), nothing, found[1:], found[0])
    return (np.abs(moved).max(-1, initial=0.0) > eps).mean(0)


def draw_hypotheses(
    fits: list[Fit], odds: Float[Floats, " fits"], random: np.random.Generator
) -> list[tuple[Fit, Float[Floats, "draws unknowns"]]]:
    """Return draws of the unknowns, of each family in proportion to its odds."""
    odds = np.exp(odds - odds.max())
    counts = np.bincount(random.choice(len(fits), DRAWS, p=odds / odds.sum()), minlength=len(fits))
    return [(fit, fit.draw(random, count)) for fit, count in zip(fits, counts.tolist(), strict=True) if count]


def choose(
    draws: list[tuple[Fit, Floats]],
    response: Response,
    count: int,
    random: np.random.Generator,
) -> Questions:
    """Return `count` questions: from each share of the situations the most informative one.

    Args:
        draws: draws of the unknowns.
        response: the policy's responses in the situations to choose from, at least `count`.
        count: number of questions.
        random: source of the simulated answers.
    """
    meaning, eps = draws[0][0].responses.meaning, draws[0][0].responses.eps
    found = [fit.right(thetas, response) for fit, thetas in draws]
    right, spread = (np.concatenate(parts) for parts in zip(*found, strict=True))
    nuisance = np.concatenate([np.tile(fit.nuisance, (len(thetas), 1)) for fit, thetas in draws])
    middle = _medoid(meaning, right, eps)
    away = meaning.offsets((), np.zeros((len(right), 0)), right, middle) / eps  # (draws, n, cues)
    centre = np.median(away, 0)
    width = np.clip(1.5 * np.median(np.abs(away - centre), 0), LEAST_SPREAD, WIDEST)
    turns = centre[None] + TURNS[:, None, None] * width[None]  # (turns, n, cues)
    apart = away[:, None] - turns[None]
    spread = np.broadcast_to(spread[:, None], apart.shape)
    of_cues = [_chances(apart[..., cue], spread[..., cue], nuisance) for cue in range(apart.shape[-1])]
    shares = np.array_split(np.arange(right.shape[1]), count)
    index, turn, worth = _told_most(np.stack([np.asarray(one) for one in of_cues]), shares, random)
    turned = np.stack([turns[turn[:, cue], index, cue] for cue in range(turns.shape[-1])], -1)
    action = meaning.moved(middle[index], turned[None] * eps)[0]
    return Questions(index, action, np.zeros(count), worth)


def _told_most(
    chance: Float[Floats, "cues answers draws turns n"], shares: list[Floats], random: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """Return for each share of the situations the most informative one, its turn of the action, and its information.

    Questions are chosen one after another. Each draw in turn is taken as the truth, answers the earlier questions, and
    so weights all draws.
    """
    cues, _, draws = chance.shape[:3]
    weight = np.full((draws, draws), 1 / draws)  # (truth, draw)
    own = _entropy(chance.swapaxes(0, 1))  # (cues, draws, turns, n)
    index, turn, worth = [], [], []
    for share in shares:
        mean = np.einsum("td,chdkn->hctkn", weight, chance[..., share])
        told = (_entropy(mean) - np.einsum("td,cdkn->ctkn", weight, own[..., share])).mean(1)  # (cues, turns, n)
        best = told.max(1).sum(0).argmax()
        index.append(share[best])
        turn.append(told[..., best].argmax(1))
        worth.append(told[..., best].max(1).sum())
        for cue in range(cues):
            said = chance[cue, :, :, turn[-1][cue], share[best]]  # (answers, draws)
            # simulated answer of each draw as truth
            answer = (said.cumsum(0) < random.random(draws)[None]).sum(0).clip(max=2)
            weight = weight * said[answer]
        weight /= weight.sum(1, keepdims=True)
    return np.array(index), np.array(turn), np.array(worth)


def _medoid(meaning: Meaning, right: Float[Floats, "draws n action"], eps: float) -> Float[Floats, "n action"]:
    """Return for each situation the possible action that is nearest to the others."""
    nothing = np.zeros((len(right), 0))
    apart = [np.minimum(np.abs(meaning.offsets((), nothing, right, one)), WIDEST * eps).sum((0, 2)) for one in right]
    return np.take_along_axis(right, np.argmin(apart, 0)[None, :, None], 0)[0]


@jax.jit
def _chances(
    offset: Float[Array, "draws turns n"], spread: Float[Array, "draws turns n"], nuisance: Float[Array, "draws grid"]
) -> Float[Array, "answers draws turns n"]:
    """Return the probability of each answer about one cue under each draw."""
    return jnp.stack([jnp.einsum("dtng,dg->dtn", chances(offset, spread, h), nuisance) for h in ANSWERS])


def _entropy(chance: Float[Floats, "answers *n"]) -> Float[Floats, "*n"]:
    return -(chance * np.log(np.maximum(chance, 1e-12))).sum(0)
