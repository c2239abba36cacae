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
    """Return the 25% trimmed mean over the seeds on `axis`: of n values, floor(n / 4) are dropped at each end.

    So up to 3 values give the plain mean, 4 to 7 values drop one at each end, and 8 to 11 drop two.
    """
    return np.asarray(scipy.stats.trim_mean(np.asarray(values, dtype=float), 0.25, axis=axis))


def interval(
    values: Float[np.ndarray, "seeds *steps"],
    resamples: int = RESAMPLES,
    each: Float[np.ndarray, "seeds episodes"] | None = None,
) -> Interval:
    """Return the interquartile mean over seeds with its 95% percentile bootstrap interval.

    Seeds are drawn with replacement, whole curves at a time; equal data gives equal intervals. `each`: results of
    episodes whose means are the values. All seeds play the same episodes, which are then drawn too, so that the
    interval holds the error of the evaluation. The bounds are NaN for a single seed. With few seeds the interval is too
    narrow: on normal data it covered the truth in 75% of 4,000 trials with 3 seeds, in 90% with 5, and in 94% with 10
    or more.

    Raises ValueError if there are no seeds, or a value is NaN.
    """
    data = np.asarray(values, dtype=float)
    if not len(data):
        raise ValueError("an interval needs at least one seed")
    if np.isnan(data).any():
        raise ValueError("values are NaN: leave out evaluations that are missing")
    estimate = interquartile_mean(data)
    if len(data) == 1:
        return Interval(estimate, np.full_like(estimate, np.nan), np.full_like(estimate, np.nan))
    return Interval(estimate, *np.quantile(resampled(data, resamples, each=each), [0.025, 0.975], axis=0))


def curve(steps: Int[np.ndarray, "steps"], values: Float[np.ndarray, "seeds steps"]) -> Curve:
    """Return the interval at each evaluation, see `interval`."""
    return Curve(np.asarray(steps), *interval(values))


def stretches_apart(curve_a: Curve, curve_b: Curve) -> list[tuple[int, int]]:
    """Return where the interval of `curve_a` lies wholly above that of `curve_b`, among the steps that both have.

    Each unbroken stretch is (first step, last step). Each evaluation is compared by itself, so a short stretch may be
    chance.
    """
    steps, a, b = np.intersect1d(curve_a.steps, curve_b.steps, return_indices=True)
    above = curve_a.lower[a] > curve_b.upper[b]  # False where a bound is NaN
    edges = np.flatnonzero(np.diff(np.concatenate([[False], above, [False]]).astype(int)))
    return [(int(steps[start]), int(steps[end - 1])) for start, end in edges.reshape(-1, 2)]


def mean_over_curve(
    steps: Int[np.ndarray, "steps"], values: Float[np.ndarray, "seeds steps"]
) -> Float[np.ndarray, "seeds"]:
    """Return the mean of each seed's curve over its steps: the area by the trapezoidal rule over the span."""
    span = float(steps[-1] - steps[0])
    area = np.trapezoid(values, np.asarray(steps, dtype=float), axis=-1)
    return area / span if span > 0 else np.asarray(values, dtype=float)[..., 0]


def steps_to_reach(
    steps: Int[np.ndarray, "steps"], values: Float[np.ndarray, "seeds steps"], threshold: float
) -> Float[np.ndarray, "seeds"]:
    """Return the step of each seed's first evaluation at or above `threshold`; infinity if there is none."""
    reached = np.asarray(values) >= threshold
    return np.where(reached.any(axis=-1), np.asarray(steps, dtype=float)[reached.argmax(axis=-1)], np.inf)


def resampled(
    values: Float[np.ndarray, "seeds *steps"],
    resamples: int = RESAMPLES,
    seed: int = 0,
    each: Float[np.ndarray, "seeds episodes"] | None = None,
) -> Float[np.ndarray, "resamples *steps"]:
    """Return interquartile means over seeds drawn with replacement, whole curves at a time, as in `interval`.

    Several variants are drawn independently, each with its own `seed`. A single seed of a variant gives no spread.
    """
    values, random = np.asarray(values, dtype=float), np.random.default_rng(seed)
    drawn = random.integers(0, len(values), (resamples, len(values)))
    if each is not None:
        each = np.asarray(each, dtype=float)
        episodes = np.random.default_rng(0).integers(0, each.shape[1], (resamples, each.shape[1]))
        rows = [own[episodes].mean(1) for own in each]
        return interquartile_mean(np.take_along_axis(np.stack(rows, 1), drawn, 1), axis=1)
    batch = max(1, _BATCH_ELEMENTS // max(1, values.size))
    parts = [interquartile_mean(values[drawn[at : at + batch]], axis=1) for at in range(0, resamples, batch)]
    return np.concatenate(parts)
