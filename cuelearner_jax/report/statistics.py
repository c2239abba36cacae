"""Statistics over seeds: interquartile means with bootstrap intervals, and quantities derived from curves.

Everything here is NumPy on recorded results; the first axis is always the seeds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

RESAMPLES = 2000
_BATCH_ELEMENTS = 4_000_000  # most numbers in memory at a time while resampling: 32 MB


class Interval(NamedTuple):
    """An estimate with its confidence interval; the bounds are NaN where there are too few seeds for one."""

    estimate: Float[np.ndarray, "*steps"]
    lower: Float[np.ndarray, "*steps"]
    upper: Float[np.ndarray, "*steps"]

    @property
    def excludes_zero(self) -> bool:
        """Whether zero lies outside the interval of a single number."""
        return bool(self.lower > 0 or self.upper < 0)

    def __str__(self) -> str:
        """Format the interval of a single number for tables."""
        bounds = "" if np.isnan(self.lower) else f" [{self.lower:.3f}, {self.upper:.3f}]"
        return f"{self.estimate:.3f}{bounds}"


class Curve(NamedTuple):
    """An interval at each evaluation step."""

    steps: Int[np.ndarray, "steps"]  # environment steps of a seed, ascending
    estimate: Float[np.ndarray, "steps"]
    lower: Float[np.ndarray, "steps"]
    upper: Float[np.ndarray, "steps"]


def interquartile_mean(values: ArrayLike, axis: int = 0) -> Float[np.ndarray, "*rest"]:
    """Return the 25% trimmed mean: the mean without the lowest and the highest quarter of the values.

    The definition is that of `scipy.stats.trim_mean(values, 0.25)`: of n values, floor(n / 4) are dropped at each end.
    So up to 3 values give the plain mean, 4 to 7 values drop one at each end, and 8 to 11 drop two.

    Args:
        values: array of any shape; `axis` is the seeds.

    Returns:
        Array of that shape without `axis`.
    """
    return np.asarray(scipy.stats.trim_mean(np.asarray(values, dtype=float), 0.25, axis=axis))


def interval(
    *strata: Float[np.ndarray, "seeds *steps"], confidence: float = 0.95, resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Return the interquartile mean over all seeds with its stratified percentile bootstrap interval.

    Seeds are drawn with replacement, whole curves at a time, within each stratum (for instance each task) separately.
    The interquartile mean is taken over the seeds of all strata together. One stratum gives the ordinary bootstrap.

    With few seeds the interval is too narrow. On normal data a nominal 95% interval covered the truth in 75% of 4,000
    trials with 3 seeds, in 90% with 5, and in 94% with 10 or more.

    Args:
        strata: arrays of shape (seeds, *steps); only the number of seeds may differ.
        confidence: nominal coverage of the interval.
        resamples: number of bootstrap samples.
        seed: seed of the resampling; equal data gives equal intervals.

    Returns:
        Arrays of shape (*steps); the bounds are NaN if a stratum has a single seed.

    Raises:
        ValueError: there are no seeds, or a value is NaN.
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


def drawn(
    groups: int, members: int, resamples: int = RESAMPLES, seed: int = 0
) -> tuple[Int[np.ndarray, "draws groups 1"], Int[np.ndarray, "draws groups members"]]:
    """Return indices of a bootstrap over groups and over each group's members, such as agents with several label seeds.

    The first draw is the original data. Index an array (groups, members, ...) with both results.
    """
    random = np.random.default_rng(seed)
    outer = random.integers(0, groups, (resamples, groups))
    inner = random.integers(0, members, (resamples, groups, members))
    outer = np.concatenate([np.arange(groups)[None], outer])
    own = np.broadcast_to(np.arange(members), (1, groups, members))
    return outer[..., None], np.concatenate([own, inner])


def interval_of_groups(values: Float[np.ndarray, "groups members"], seed: int = 0) -> Interval:
    """Return the interquartile mean over the groups' means, with a 95% bootstrap interval over groups and members."""
    if values.shape[1] == 1:
        return interval(values[:, 0], seed=seed)
    means = interquartile_mean(values[drawn(*values.shape, seed=seed)].mean(-1), axis=1)
    lower, upper = np.quantile(means[1:], [0.025, 0.975]) if len(values) > 1 else (np.nan, np.nan)
    return Interval(means[0], np.asarray(lower), np.asarray(upper))


def curve(
    steps: Int[np.ndarray, "steps"], *strata: Float[np.ndarray, "seeds steps"], confidence: float = 0.95, seed: int = 0
) -> Curve:
    """Return the interval at each evaluation, see `interval`."""
    return Curve(np.asarray(steps), *interval(*strata, confidence=confidence, seed=seed))


def stretches_apart(curve_a: Curve, curve_b: Curve) -> list[tuple[int, int]]:
    """Return the stretches of steps where the interval of `curve_a` lies wholly above that of `curve_b`.

    Each evaluation is compared by itself. Among many evaluations a few may differ by chance, so a long stretch is
    stronger evidence than a short one.

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
    """Return the area under each seed's curve by the trapezoidal rule [metric times environment steps]."""
    return np.trapezoid(values, np.asarray(steps, dtype=float), axis=-1)


def mean_over_curve(
    steps: Int[np.ndarray, "steps"], values: Float[np.ndarray, "seeds steps"]
) -> Float[np.ndarray, "seeds"]:
    """Return the mean of each seed's curve over its steps: the area over the span, correct for uneven steps too.

    The mean of a curve with one evaluation is its value.
    """
    span = float(steps[-1] - steps[0])
    return area_under_curve(steps, values) / span if span > 0 else np.asarray(values, dtype=float)[..., 0]


def steps_to_reach(
    steps: Int[np.ndarray, "steps"], values: Float[np.ndarray, "seeds steps"], threshold: float
) -> Float[np.ndarray, "seeds"]:
    """Return the step of each seed's first evaluation at or above `threshold`; infinity if there is none."""
    reached = np.asarray(values) >= threshold
    return np.where(reached.any(axis=-1), np.asarray(steps, dtype=float)[reached.argmax(axis=-1)], np.inf)


def resampled(
    values: Float[np.ndarray, "seeds *steps"], resamples: int = RESAMPLES, seed: int = 0
) -> Float[np.ndarray, "resamples *steps"]:
    """Return interquartile means over seeds drawn with replacement, whole curves at a time, as in `interval`.

    This serves statistics of several variants, which are drawn independently, each with its own `seed`. A single seed
    is drawn repeatedly, so it gives no spread.
    """
    values = np.asarray(values, dtype=float)
    drawn = np.random.default_rng(seed).integers(0, len(values), (resamples, len(values)))
    batch = max(1, _BATCH_ELEMENTS // max(1, values.size))
    parts = [interquartile_mean(values[drawn[at : at + batch]], axis=1) for at in range(0, resamples, batch)]
    return np.concatenate(parts)
