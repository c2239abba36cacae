"""Statistics over seeds: interquartile means with bootstrap intervals, and what can be read off their curves.

Everything here is NumPy on results that are already recorded; the first axis is always the seeds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.optimize
import scipy.stats
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

RESAMPLES = 2000
_BATCH_ELEMENTS = 4_000_000  # numbers held at a time while resampling: 32 MB


class Interval(NamedTuple):
    """An estimate with its confidence interval; the bounds are NaN where there are too few seeds for one."""

    estimate: Float[np.ndarray, "*steps"]
    lower: Float[np.ndarray, "*steps"]
    upper: Float[np.ndarray, "*steps"]


class Curve(NamedTuple):
    """An interval at each evaluation."""

    steps: Int[np.ndarray, "steps"]  # environment steps of a seed, ascending
    estimate: Float[np.ndarray, "steps"]
    lower: Float[np.ndarray, "steps"]
    upper: Float[np.ndarray, "steps"]


def interquartile_mean(values: ArrayLike, axis: int = 0) -> Float[np.ndarray, "*rest"]:
    """The mean of what is left when the lowest and the highest quarter are cut off: the 25% trimmed mean.

    The definition is that of `scipy.stats.trim_mean(values, 0.25)`: of n values, floor(n / 4) are dropped at each end,
    never a fraction of one. So up to 3 values give the plain mean, 4 to 7 drop one at each end (5 average the middle
    three), 8 to 11 drop two.

    Args:
        values: array of any shape; `axis` is the seeds.

    Returns:
        Array of that shape without `axis`.
    """
    return np.asarray(scipy.stats.trim_mean(np.asarray(values, dtype=float), 0.25, axis=axis))


def interval(
    *strata: Float[np.ndarray, "seeds *steps"], confidence: float = 0.95, resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """The interquartile mean over all seeds with its stratified percentile bootstrap interval.

    Seeds are drawn with replacement, whole curves at a time, inside each stratum (for instance each task) separately;
    the interquartile mean is taken over the seeds of all strata together. One stratum gives the ordinary bootstrap.
    With few seeds the interval is too narrow: on normal data a nominal 95% covered the truth in 75% of 4,000 trials
    with 3 seeds, in 90% with 5 and in 94% with 10 or more.

    Args:
        strata: arrays of shape (seeds, *steps); the number of seeds may differ, the rest not.
        confidence: nominal coverage of the interval.
        resamples: number of bootstrap samples.
        seed: seed of the resampling, so that the same data always gives the same interval.

    Returns:
        Arrays of shape (*steps); the bounds are NaN if a stratum has a single seed.

    Raises:
        ValueError: if there are no seeds or a value is NaN.
    """
    data = tuple(np.moveaxis(np.asarray(stratum, dtype=float), 0, -1) for stratum in strata)
    if not data or min(stratum.shape[-1] for stratum in data) == 0:
        raise ValueError("an interval needs at least one seed in each stratum")
    if any(np.isnan(stratum).any() for stratum in data):
        raise ValueError("values are NaN: leave out evaluations that are missing")
    estimate = interquartile_mean(np.concatenate(data, axis=-1), axis=-1)
    if min(stratum.shape[-1] for stratum in data) == 1:
        return Interval(estimate, np.full_like(estimate, np.nan), np.full_like(estimate, np.nan))
    size = max(1, sum(stratum.size for stratum in data))
    result = scipy.stats.bootstrap(
        data,
        lambda *samples, axis: interquartile_mean(np.concatenate(samples, axis=axis), axis=axis),
        n_resamples=resamples,
        batch=min(resamples, max(1, _BATCH_ELEMENTS // size)),
        vectorized=True,
        axis=-1,
        confidence_level=confidence,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    bounds = result.confidence_interval
    return Interval(estimate, np.asarray(bounds.low), np.asarray(bounds.high))


def curve(
    steps: Int[np.ndarray, "steps"], *strata: Float[np.ndarray, "seeds steps"], confidence: float = 0.95, seed: int = 0
) -> Curve:
    """The interval (see there) at each evaluation."""
    return Curve(np.asarray(steps), *interval(*strata, confidence=confidence, seed=seed))


def stretches_apart(curve_a: Curve, curve_b: Curve) -> list[tuple[int, int]]:
    """Where the interval of `curve_a` lies wholly above that of `curve_b`.

    The intervals hold at each evaluation by itself: of many evaluations, a few may come apart by chance, so trust a
    long stretch more than a short one.

    Returns:
        (first step, last step) of each unbroken stretch of the steps that both curves have; empty if there is none.
    """
    steps, a, b = np.intersect1d(curve_a.steps, curve_b.steps, return_indices=True)
    above = curve_a.lower[a] > curve_b.upper[b]  # False where a bound is NaN
    edges = np.flatnonzero(np.diff(np.concatenate([[False], above, [False]]).astype(int)))
    return [(int(steps[start]), int(steps[end - 1])) for start, end in edges.reshape(-1, 2)]


def area_under_curve(
    steps: Int[np.ndarray, "steps"], values: Float[np.ndarray, "seeds steps"]
) -> Float[np.ndarray, "seeds"]:
    """The area under each seed's curve by the trapezoidal rule, in units of the metric times environment steps."""
    return np.trapezoid(values, np.asarray(steps, dtype=float), axis=-1)


def mean_over_curve(
    steps: Int[np.ndarray, "steps"], values: Float[np.ndarray, "seeds steps"]
) -> Float[np.ndarray, "seeds"]:
    """The mean of each seed's curve over its steps: the area over the span, so uneven steps weigh what they should.

    A curve of one evaluation has that value as its mean.
    """
    span = float(steps[-1] - steps[0])
    return area_under_curve(steps, values) / span if span > 0 else np.asarray(values, dtype=float)[..., 0]


def steps_to_reach(
    steps: Int[np.ndarray, "steps"], values: Float[np.ndarray, "seeds steps"], threshold: float
) -> Float[np.ndarray, "seeds"]:
    """The step of the first evaluation at which each seed is at or above `threshold`; infinity if it never is."""
    reached = np.asarray(values) >= threshold
    return np.where(reached.any(axis=-1), np.asarray(steps, dtype=float)[reached.argmax(axis=-1)], np.inf)


def step_at_level(
    steps: Float[np.ndarray, "steps"] | Int[np.ndarray, "steps"],
    curves: Float[np.ndarray, "*curves steps"],
    level: Float[np.ndarray, "*curves"] | float,
) -> Float[np.ndarray, "*curves"]:
    """Where each curve first reaches its level, on straight lines between evaluations; infinity if it never does.

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


def resampled(
    values: Float[np.ndarray, "seeds *steps"], resamples: int = RESAMPLES, seed: int = 0
) -> Float[np.ndarray, "resamples *steps"]:
    """Interquartile means over seeds drawn with replacement, whole curves at a time: the bootstrap of `interval`.

    For statistics that need more than one variant: those of different variants are drawn independently, each with its
    own `seed`. A single seed is drawn again and again, so it gives no spread.
    """
    values = np.asarray(values, dtype=float)
    drawn = np.random.default_rng(seed).integers(0, len(values), (resamples, len(values)))
    batch = max(1, _BATCH_ELEMENTS // max(1, values.size))
    parts = [interquartile_mean(values[drawn[at : at + batch]], axis=1) for at in range(0, resamples, batch)]
    return np.concatenate(parts)


class Bounds(NamedTuple):
    """What is known of a quantity: it lies between these; they are equal where it is known exactly.

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
    """What is then known of the ratio of two quantities that are not negative; nothing (0 to infinity) of 0 to 0."""

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
