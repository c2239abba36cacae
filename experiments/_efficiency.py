"""Label efficiency: steps to a level, areas under the curve, and the labels that buy either, with intervals.

The steps to a level are the interquartile mean over seeds of the step from which a seed stays at the level or above.
Intervals are 95% percentile bootstraps over seeds and episodes (`statistics.resampled`), 2,000 draws; the seeds of a
variant are drawn independently of those of others. A level is held fixed. A curve that ends below the level is
right-censored (`Bounds`): its steps are "more than the last", which ratios and intervals carry on as a bound, never as
a number.

Samples lead with the estimate of the real seeds; the draws follow.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float, Int

from cuelearner_jax.errors import UserError
from cuelearner_jax.report import statistics
from cuelearner_jax.report.tables import Row, identity, unguided_of
from cuelearner_jax.report.variants import Variant

Samples = Float[np.ndarray, "samples"]


@dataclass(frozen=True)
class Question:
    """Question that a study asks about label budgets."""

    level: float | None = None  # of the metric; None: see `level_at`
    level_at: int | None = None  # or what the first unguided agents have at this step; None: at the last shared by all
    within: float = 2 / 3  # share of the unguided agents' steps in which a budget is to reach the level
    reference: str | None = None  # kind of guidance with whose labels others' are compared; None: each

    def __post_init__(self) -> None:
        if self.level is not None and self.level_at is not None:
            raise UserError("--level is a value, --level-at a step of the unguided agents: give one of them")
        if self.level is not None and not np.isfinite(self.level):
            raise UserError(f"--level is {self.level}: give a finite number")
        if not 0 < self.within <= 1:
            raise UserError(f"--within is {self.within}: give a share of steps above 0, at most 1")


class Efficiency(NamedTuple):
    """Result of a study of label efficiency; tables by file name."""

    level: float
    origin: str  # of the level, in words
    shared: int  # step to which areas are taken
    tables: dict[str, list[Row]]


class Bounds(NamedTuple):
    """Bounds of a quantity; they are equal where it is known exactly."""

    lower: Samples
    upper: Samples


class Drawn:
    """A variant with the bootstrap of its seeds; values are signed so that larger ones are better."""

    def __init__(self, variant: Variant, sign: float, shared: int) -> None:
        """Draw nothing yet; the area is taken to the step `shared`."""
        self.variant, self.steps, self.sign = variant, variant.curve.steps, sign
        self.until = max(1, int(np.searchsorted(self.steps, shared, side="right")))
        self._steps: dict[float, Bounds] = {}
        # Its own stream, whatever other variants there are.
        self.stream = zlib.crc32(f"{variant.run}/{variant.guidance}/{variant.labels}".encode())

    @cached_property
    def areas(self) -> Samples:
        """The interquartile mean of the seeds' means over the curve."""
        steps, until = self.steps[: self.until], self.until
        return self._samples(lambda curves: statistics.mean_over_curve(steps, curves[..., :until]))

    def _samples(self, of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        own = statistics.interquartile_mean(of(self.variant.values))
        return np.concatenate([own[None], statistics.resampled(self.variant.groups, seed=self.stream, of=of)])

    def steps_to(self, level: float) -> Bounds:
        """Steps to a (signed) level; the draws are those of `areas`."""
        if level not in self._steps:
            bounds = lambda curves: statistics.steps_to_level(self.steps, self.sign * curves, level)  # noqa: E731
            self._steps[level] = Bounds(*self._samples(bounds).T)
        return self._steps[level]


def ratio_bounds(above: Bounds, below: Bounds) -> Bounds:
    """Return the bounds of the ratio of two non-negative quantities; 0 to infinity for 0 over 0."""

    def divided(numerator: Samples, denominator: Samples, otherwise: float) -> Samples:
        unknown = ((numerator == 0) & (denominator == 0)) | (np.isinf(numerator) & np.isinf(denominator))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(unknown, otherwise, numerator / denominator)

    return Bounds(divided(above.lower, below.upper, 0.0), divided(above.upper, below.lower, np.inf))


def labels_for(
    budgets: Int[np.ndarray, "budgets"], areas: Float[np.ndarray, "samples budgets"], wanted: Samples
) -> Bounds:
    """Labels at which areas under the curve, nondecreasing in the budget, first reach what is wanted.

    Areas lie on straight lines over the logarithm of the labels between two budgets; beyond the budgets all that is
    known is that more than the largest are needed, or no more than the smallest.
    """
    first = areas[:, 0] >= wanted
    exact = np.where(first, float(budgets[0]), np.exp(statistics.step_at_level(np.log(budgets), areas, wanted)))
    return Bounds(np.where(first, 0.0, np.minimum(exact, float(budgets[-1]))), exact)


def columns(name: str, samples: Bounds, *drawn: Drawn) -> Row:
    """Return the table columns of an estimate with its interval; without one for a variant with a single seed.

    The column `name` is empty where only `name_above` or `name_below` is known.
    """
    low, high = float(samples.lower[0]), float(samples.upper[0])
    ends = (np.nan, np.nan)
    if all(len(each.variant.seeds) > 1 for each in drawn):
        ends = statistics.censored_interval(np.stack(samples, -1)[1:])
    row = interval_columns(name, (low if low == high else np.nan, *ends))
    exact = low == high or np.isnan(low)
    return row | {f"{name}_above": "" if exact else low, f"{name}_below": "" if exact else high}


def interval_columns(name: str, found: Sequence[float | np.ndarray]) -> Row:
    """Return an interval's table columns, empty without a number."""
    ends = zip(("", "_lower", "_upper"), map(float, found), strict=True)
    return {name + end: "" if np.isnan(value) else value for end, value in ends}


NOTHING = (np.nan,) * 3


def efficiency_of(variants: Sequence[Variant], question: Question, lower_is_better: bool = False) -> Efficiency:
    """Return the label efficiency of recorded curves.

    Args:
        variants: of one task and metric.
        question: level and what is compared.
        lower_is_better: small values are good ones.

    Raises:
        UserError: there is no level without unguided agents, or they begin at it, or a reference is not there.
    """
    sign = -1.0 if lower_is_better else 1.0
    shared = min(int(variant.curve.steps[-1]) for variant in variants)
    kinds = {variant.guidance for variant in variants if variant.labels}
    if question.reference is not None and question.reference not in kinds:
        there = ", ".join(sorted(kinds)) or "none"
        raise UserError(f"--reference {question.reference}: no results with its labels; there are {there}")
    level, origin = _level(variants, question, shared)
    drawn = {id(variant): Drawn(variant, sign, shared) for variant in variants}
    rows, to_level, equal = [], [], []
    for variant in variants:
        own, unguided = drawn[id(variant)], unguided_of(variant, variants)
        if variant.guidance == "none" and sign * (level - variant.curve.estimate[0]) <= 0:
            raise UserError(
                f"the level {level:.3g} is no better than what {variant.name} begins with "
                f"({variant.curve.estimate[0]:.3g}): give another --level or a later --level-at"
            )
        against = drawn[id(unguided)] if unguided is not None and unguided is not variant else None
        rows.append(_row(own, against, sign * level))
    for run in dict.fromkeys(variant.run for variant in variants):
        asking: dict[str, list[Drawn]] = {}
        for variant in variants:
            if variant.run == run and variant.labels:
                asking.setdefault(variant.guidance, []).append(drawn[id(variant)])
        for kind, own in asking.items():
            if (unguided := unguided_of(own[0].variant, variants)) is not None:
                row = {**_run(run), "guidance": kind, "level": level, "within": question.within}
                to_level.append(row | _labels_to_level(own, drawn[id(unguided)], sign * level, question.within))
        equal += _equal_area(run, asking, question.reference, sign)
    tables = {"efficiency": rows, "labels_to_level": to_level, "equal_area": equal}
    return Efficiency(level, origin, shared, {name: table for name, table in tables.items() if table})


def _run(name: str) -> Row:
    return {"run": name} if name else {}


def _level(variants: Sequence[Variant], question: Question, shared: int) -> tuple[float, str]:
    """The level and where it comes from. Raises UserError if there is none."""
    if question.level is not None:
        return question.level, "given"
    unguided = next((variant for variant in variants if variant.guidance == "none"), None)
    if unguided is None:
        raise UserError("no results of unguided agents, whose level would be the one to reach: give --level")
    steps = unguided.curve.steps
    at = question.level_at if question.level_at is not None else int(steps[np.searchsorted(steps, shared, "right") - 1])
    if at not in steps:
        raise UserError(f"--level-at {at}: {unguided.name} has no such step, but {', '.join(map(str, steps))}")
    level = float(unguided.curve.estimate[np.flatnonzero(steps == at)[0]])
    return level, f"that of {unguided.name} at step {at:,}"


def _row(own: Drawn, unguided: Drawn | None, level: float) -> Row:
    """Return a variant's row of `efficiency.csv`; ratios and differences are to the unguided agents'."""
    variant, steps = own.variant, own.steps_to(level)
    row: Row = {**identity(variant), "seeds": len(variant.seeds), "against": unguided.variant.name if unguided else ""}
    row |= interval_columns("guide", NOTHING if variant.guide is None else statistics.interval(variant.guide))
    row |= columns("steps_to_level", steps, own) | {"reached": float(np.isfinite(steps.upper[1:]).mean())}
    mean = interval_columns("mean", variant.mean)
    if unguided is None:
        nothing = interval_columns("steps_ratio", NOTHING) | {"steps_ratio_above": "", "steps_ratio_below": ""}
        return (
            row
            | nothing
            | mean
            | interval_columns("mean_difference", NOTHING)
            | interval_columns("mean_ratio", NOTHING)
        )
    row |= columns("steps_ratio", ratio_bounds(steps, unguided.steps_to(level)), own, unguided) | mean
    difference = own.areas - unguided.areas
    pairs = {
        "mean_difference": Bounds(difference, difference),
        "mean_ratio": ratio_bounds(*(Bounds(each.areas, each.areas) for each in (own, unguided))),
    }
    for name, samples in pairs.items():
        known = columns(name, samples, own, unguided)
        row |= {column: known[column] for column in (name, f"{name}_lower", f"{name}_upper")}
    return row | ({"mean_ratio": ""} if unguided.areas[0] == 0 else {})


def _labels_to_level(own: Sequence[Drawn], unguided: Drawn, level: float, within: float) -> Row:
    """The smallest budget of a kind whose curve is known to reach the level within a share of the unguided steps."""
    budgets = np.array([each.variant.labels for each in own], float)
    limit = within * unguided.steps_to(level).lower
    in_time = np.stack([each.steps_to(level).upper <= limit for each in own])
    smallest = np.where(in_time.any(axis=0), budgets[in_time.argmax(axis=0)], np.inf)
    row = columns("labels", Bounds(np.minimum(smallest, budgets[-1]), smallest), unguided, *own)
    return row | {"reached": float(np.isfinite(smallest[1:]).mean())}


def _equal_area(run: str, asking: dict[str, list[Drawn]], reference: str | None, sign: float) -> list[Row]:
    """Labels of one kind that give the area under the curve of another's (or the reference's), at each budget."""
    budgets = {kind: np.array([each.variant.labels for each in own]) for kind, own in asking.items()}
    fitted = {}  # each sample's nondecreasing least-squares fit (pool adjacent violators)
    for kind, own in asking.items():
        samples = sign * np.stack([each.areas for each in own], axis=1)
        fitted[kind] = np.stack([scipy.optimize.isotonic_regression(row).x for row in samples])
    rows = []
    for base in asking if reference is None else [kind for kind in asking if kind == reference]:
        for place, labels in enumerate(budgets[base].tolist()):
            for kind in (kind for kind in asking if kind != base):
                needed = labels_for(budgets[kind], fitted[kind], fitted[base][:, place])
                both = (*asking[base], *asking[kind])
                row = {**_run(run), "reference": base, "reference_labels": labels}
                row |= {"mean": float(sign * fitted[base][0, place]), "guidance": kind}
                row |= columns("labels", needed, *both)
                rows.append(row | columns("labels_ratio", Bounds(*(bound / labels for bound in needed)), *both))
    return rows
