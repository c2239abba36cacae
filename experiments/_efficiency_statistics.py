"""Statistics of label efficiency: steps to a level and labels to an area, as bounds where a curve ends too early."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float, Int


def step_at_level(
    steps: Float[np.ndarray, "steps"] | Int[np.ndarray, "steps"],
    curves: Float[np.ndarray, "*curves steps"],
    level: Float[np.ndarray, "*curves"] | float,
) -> Float[np.ndarray, "*curves"]:
    """Return the step at which each curve first reaches its level, by linear interpolation; infinity if never.

    A curve that begins at its level or above gives the first step, so it may have reached it earlier.
    """
    steps, curves = np.asarray(steps, dtype=float), np.asarray(curves, dtype=float)
    level = np.broadcast_to(np.asarray(level, dtype=float), curves.shape[:-1])
    reached = curves >= level[..., None]
    place = reached.argmax(axis=-1)  # 0 where it begins there, and where it never gets there
    before = np.maximum(place - 1, 0)
    low, high = (np.take_along_axis(curves, at[..., None], axis=-1)[..., 0] for at in (before, place))
    share = np.divide(level - low, high - low, out=np.zeros(level.shape), where=high > low)
    found = steps[before] + share * (steps[place] - steps[before])
    return np.where(reached.any(axis=-1), found, np.inf)


class Bounds(NamedTuple):
    """Bounds of a quantity; they are equal where it is known exactly.

    A curve that ended below its level is right-censored: all that is known of its steps to the level is that they are
    more than its last step. Bounds carry that through ratios and percentiles.
    """

    lower: Float[np.ndarray, "*samples"]
    upper: Float[np.ndarray, "*samples"]


def censored(found: Float[np.ndarray, "*samples"] | float, last: float) -> Bounds:
    """Steps to a level of which those that are infinite are only known to be more than `last`."""
    found = np.asarray(found, dtype=float)
    return Bounds(np.where(np.isinf(found), float(last), found), found)


def ratio_bounds(above: Bounds, below: Bounds) -> Bounds:
    """Return the bounds of the ratio of two non-negative quantities; 0 to infinity for 0 over 0."""

    def divided(numerator: np.ndarray, denominator: np.ndarray, otherwise: float) -> np.ndarray:
        unknown = ((numerator == 0) & (denominator == 0)) | (np.isinf(numerator) & np.isinf(denominator))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(unknown, otherwise, numerator / denominator)

    return Bounds(divided(above.lower, below.upper, 0.0), divided(above.upper, below.lower, np.inf))


def percentiles(samples: Bounds, confidence: float = 0.95) -> tuple[float, float]:
    """The percentile interval of bootstrap samples of which bounds are known: wide enough for all that they allow.

    The lower end is the percentile of the lower bounds, the upper that of the upper ones; both are values of samples,
    never between two, so that infinity ("never") keeps its meaning.
    """
    tail = (1 - confidence) / 2
    last = len(samples.lower) - 1
    low = np.sort(samples.lower)[int(np.floor(tail * last))]
    high = np.sort(samples.upper)[int(np.ceil((1 - tail) * last))]
    return float(low), float(high)


def isotonic(rows: Float[np.ndarray, "rows points"]) -> Float[np.ndarray, "rows points"]:
    """Each row's nondecreasing least-squares fit (pool adjacent violators)."""
    rows = np.atleast_2d(np.asarray(rows, dtype=float))
    return np.stack([scipy.optimize.isotonic_regression(row).x for row in rows])


def labels_for(
    budgets: Int[np.ndarray, "budgets"], areas: Float[np.ndarray, "rows budgets"], wanted: Float[np.ndarray, "rows"]
) -> Bounds:
    """Labels at which areas under the curve, nondecreasing in the budget, first reach what is wanted.

    Areas lie on straight lines over the logarithm of the labels between two budgets; beyond the budgets all that is
    known is that more than the largest are needed, or no more than the smallest.

    Args:
        budgets: ascending.
        areas: made nondecreasing, see `isotonic`.
        wanted: one for each row.
    """
    found = np.exp(step_at_level(np.log(np.asarray(budgets, dtype=float)), areas, wanted))
    first = areas[:, 0] >= wanted
    exact = np.where(first, float(budgets[0]), found)
    return Bounds(np.where(first, 0.0, censored(exact, float(budgets[-1])).lower), exact)
