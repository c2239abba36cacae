"""Label efficiency: steps to a level, areas under the curve, and the labels that buy either, with intervals.

Intervals are 95% percentile bootstraps over seeds: the seeds of every variant are drawn with replacement, independently
of those of others, 2,000 times; what is computed of the interquartile means of the real seeds is computed of each
draw's. A level is held fixed. A curve that ends below the level is right-censored (`Bounds`): its steps are "more than
the last", which ratios and intervals carry on as a bound, never as a number.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import _efficiency_statistics as bounds
import numpy as np
from _efficiency_statistics import Bounds

from cuelearner_jax.errors import UserError
from cuelearner_jax.report import statistics
from cuelearner_jax.report.statistics import Interval
from cuelearner_jax.report.tables import Row, named, unguided_of
from cuelearner_jax.report.variants import Variant


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


class Known(NamedTuple):
    """An estimate with its interval; the interval's ends are NaN for a variant with one seed."""

    bounds: Bounds  # of the estimate, each ()
    lower: float
    upper: float

    def columns(self, name: str) -> Row:
        """Return the table columns; `name` is empty where only `name_above` or `name_below` is known."""
        low, high = float(self.bounds.lower), float(self.bounds.upper)
        row = interval_columns(name, Interval(*map(np.array, (low if low == high else np.nan, self.lower, self.upper))))
        exact = low == high or np.isnan(low)
        return row | {f"{name}_above": "" if exact else low, f"{name}_below": "" if exact else high}


def interval_columns(name: str, found: Interval) -> Row:
    """Return the interval's table columns, empty without a number."""
    return {name + end: _number(value) for end, value in zip(("", "_lower", "_upper"), found, strict=True)}


class Drawn:
    """A variant with the bootstrap of its seeds; values are signed so that larger ones are better."""

    def __init__(self, variant: Variant, sign: float, shared: int) -> None:
        """Draw nothing yet; the area is taken to the step `shared`."""
        self.variant, self.sign = variant, sign
        self.steps, self.values = variant.curve.steps, sign * variant.values
        self.last = float(self.steps[-1])
        until = max(1, int(np.searchsorted(self.steps, shared, side="right")))
        self.seed_areas = statistics.mean_over_curve(self.steps[:until], variant.values[:, :until])
        # Its own stream, whatever other variants there are.
        self.stream = zlib.crc32(f"{variant.run}/{variant.guidance}/{variant.labels}".encode())
        self.alone = len(variant.seeds) == 1

    @cached_property
    def curve(self) -> np.ndarray:
        """The interquartile mean, (steps,)."""
        return statistics.interquartile_mean(self.values)

    @cached_property
    def curves(self) -> np.ndarray:
        """Return the curve of each draw, (resamples, steps)."""
        return statistics.resampled(self.values, seed=self.stream)

    @cached_property
    def areas(self) -> tuple[np.ndarray, np.ndarray]:
        """The interquartile mean of the seeds' means over the curve, (), and of each draw's, (resamples,)."""
        drawn = statistics.resampled(self.seed_areas, seed=self.stream)  # the same seeds as of `curves`
        return statistics.interquartile_mean(self.seed_areas), drawn

    def steps_to(self, level: float) -> tuple[Bounds, Bounds]:
        """Steps to a (signed) level: of the interquartile mean, each (), and of each draw's, each (resamples,)."""
        one = bounds.step_at_level(self.steps, self.curve, level)
        many = bounds.step_at_level(self.steps, self.curves, level)
        return bounds.censored(one, self.last), bounds.censored(many, self.last)


def known(one: Bounds, many: Bounds, *drawn: Drawn) -> Known:
    """An estimate with the interval of its draws, which has no ends where one of the variants has a single seed."""
    if any(each.alone for each in drawn):
        return Known(one, np.nan, np.nan)
    return Known(one, *bounds.percentiles(many))


def exactly(values: np.ndarray | float) -> Bounds:
    """Values that are known."""
    return Bounds(np.asarray(values, dtype=float), np.asarray(values, dtype=float))


class Carried(NamedTuple):
    """Label efficiency of one variant."""

    variant: Variant
    against: Variant | None  # the unguided agents that it is compared with; None: it is unguided, or there are none
    guide: Interval | None  # metric of the guide alone
    steps: Known  # to the level
    reached: float  # share of draws whose interquartile mean reaches the level
    ratio: Known | None  # of those steps to the unguided agents'
    area_difference: Interval | None  # of the mean over the curve to the unguided agents', in units of the metric
    area_ratio: Interval | None

    def row(self) -> Row:
        """Return the row of `efficiency.csv`."""
        row: Row = {**named(self.variant), "seeds": len(self.variant.seeds)}
        row |= {"against": self.against.name if self.against else ""}
        row |= interval_columns("guide", self.guide or NOTHING)
        row |= self.steps.columns("steps_to_level") | {"reached": self.reached}
        row |= self.ratio.columns("steps_ratio") if self.ratio else UNKNOWN.columns("steps_ratio")
        row |= interval_columns("mean", self.variant.mean)
        row |= interval_columns("mean_difference", self.area_difference or NOTHING)
        return _numbers(row | interval_columns("mean_ratio", self.area_ratio or NOTHING))


NOTHING = Interval(*(np.array(np.nan),) * 3)
UNKNOWN = Known(exactly(np.nan), np.nan, np.nan)


class LabelsToLevel(NamedTuple):
    """The smallest budget of a kind whose curve reaches the level within a share of the unguided agents' steps."""

    run: str
    guidance: str
    budgets: tuple[int, ...]
    labels: Known
    reached: float  # share of draws in which some budget does


class EqualArea(NamedTuple):
    """Labels of one kind that give the area under the curve of another kind's labels."""

    run: str
    reference: str
    reference_labels: int
    area: float  # in units of the metric
    guidance: str
    labels: Known
    ratio: Known  # of those labels to the reference's


@dataclass(frozen=True)
class Efficiency:
    """Result of a study of label efficiency."""

    question: Question
    level: float
    origin: str  # of the level, in words
    shared: int  # step to which areas are taken
    carried: tuple[Carried, ...]
    labels_to_level: tuple[LabelsToLevel, ...]
    equal_area: tuple[EqualArea, ...]

    def tables(self) -> dict[str, list[Row]]:
        """Tables by file name."""
        found = {"efficiency": [each.row() for each in self.carried]}
        if self.labels_to_level:
            found["labels_to_level"] = [
                _run(each.run)
                | {"guidance": each.guidance, "level": self.level, "within": self.question.within}
                | _numbers(each.labels.columns("labels") | {"reached": each.reached})
                for each in self.labels_to_level
            ]
        if self.equal_area:
            found["equal_area"] = [
                _run(each.run)
                | {"reference": each.reference, "reference_labels": each.reference_labels, "mean": each.area}
                | {"guidance": each.guidance}
                | _numbers(each.labels.columns("labels") | each.ratio.columns("labels_ratio"))
                for each in self.equal_area
            ]
        return found


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
    for variant in variants:
        if variant.guidance == "none" and sign * level <= drawn[id(variant)].curve[0]:
            raise UserError(
                f"the level {level:.3g} is no better than what {variant.name} begins with "
                f"({variant.curve.estimate[0]:.3g}): give another --level or a later --level-at"
            )
    carried, to_level, equal = [], [], []
    for variant in variants:
        unguided = unguided_of(variant, variants)
        against = drawn[id(unguided)] if unguided is not None and unguided is not variant else None
        carried.append(_carried(drawn[id(variant)], against, sign * level))
    for run in dict.fromkeys(variant.run for variant in variants):
        asking: dict[str, list[Drawn]] = {}
        for variant in variants:
            if variant.run == run and variant.labels:
                asking.setdefault(variant.guidance, []).append(drawn[id(variant)])
        for own in asking.values():
            unguided = unguided_of(own[0].variant, variants)
            if unguided is not None:
                to_level.append(_labels_to_level(own, drawn[id(unguided)], sign * level, question.within))
        equal += _equal_area(asking, question.reference, sign)
    return Efficiency(question, level, origin, shared, tuple(carried), tuple(to_level), tuple(equal))


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


def _carried(own: Drawn, unguided: Drawn | None, level: float) -> Carried:
    one, many = own.steps_to(level)
    guide = None if own.variant.guide is None else statistics.interval(own.variant.guide)
    steps, reached = known(one, many, own), float(np.isfinite(many.upper).mean())
    if unguided is None:
        return Carried(own.variant, None, guide, steps, reached, None, None, None)
    below, belows = unguided.steps_to(level)
    ratio = known(bounds.ratio_bounds(one, below), bounds.ratio_bounds(many, belows), own, unguided)
    (area, areas), (other, others) = own.areas, unguided.areas
    difference = known(exactly(area - other), exactly(areas - others), own, unguided)
    more = Interval(difference.bounds.lower, np.array(difference.lower), np.array(difference.upper))
    pairs = ((area, other), (areas, others))
    one, many = (bounds.ratio_bounds(exactly(above), exactly(under)) for above, under in pairs)
    times = known(one, many, own, unguided)
    share = Interval(np.where(other == 0, np.nan, one.lower), np.array(times.lower), np.array(times.upper))
    return Carried(own.variant, unguided.variant, guide, steps, reached, ratio, more, share)


def _labels_to_level(own: Sequence[Drawn], unguided: Drawn, level: float, within: float) -> LabelsToLevel:
    """See `LabelsToLevel`; a budget counts only where it is known to reach the level in time."""
    budgets = np.array([each.variant.labels for each in own], float)
    smallest = []
    for which in (0, 1):  # the seeds there are, then the draws
        limit = within * np.atleast_1d(unguided.steps_to(level)[which].lower)
        in_time = np.stack([np.atleast_1d(each.steps_to(level)[which].upper) <= limit for each in own])
        smallest.append(np.where(in_time.any(axis=0), budgets[in_time.argmax(axis=0)], np.inf))
    one, many = (bounds.censored(found, budgets[-1]) for found in smallest)
    labels = known(Bounds(one.lower[0], one.upper[0]), many, unguided, *own)
    variant = own[0].variant
    reached = float(np.isfinite(many.upper).mean())
    return LabelsToLevel(variant.run, variant.guidance, tuple(int(budget) for budget in budgets), labels, reached)


def _equal_area(asking: dict[str, list[Drawn]], reference: str | None, sign: float) -> list[EqualArea]:
    """Every kind against every other (or the reference) of one run, at each budget of the other's."""
    budgets = {kind: np.array([each.variant.labels for each in own]) for kind, own in asking.items()}
    fitted = {}
    for kind, own in asking.items():
        one = np.array([[each.areas[0] for each in own]])
        many = np.stack([each.areas[1] for each in own], axis=1)
        fitted[kind] = bounds.isotonic(sign * one), bounds.isotonic(sign * many)
    found = []
    for base, own in asking.items():
        if reference not in (None, base):
            continue
        for place, labels in enumerate(budgets[base].tolist()):
            for kind, others in asking.items():
                if kind == base:
                    continue
                one, many = (
                    bounds.labels_for(budgets[kind], fitted[kind][which], fitted[base][which][:, place])
                    for which in (0, 1)
                )
                one = Bounds(one.lower[0], one.upper[0])
                needed = known(one, many, *own, *others)
                ratio = known(Bounds(*(b / labels for b in one)), Bounds(*(b / labels for b in many)), *own, *others)
                area = float(sign * fitted[base][0][0, place])
                found.append(EqualArea(own[0].variant.run, base, labels, area, kind, needed, ratio))
    return found


def _run(name: str) -> Row:
    return {"run": name} if name else {}


def _number(value: str | int | float | np.ndarray) -> str | int | float:
    """A plain number, or nothing where there is none."""
    if isinstance(value, str | int):
        return value
    return "" if np.isnan(value) else float(value)


def _numbers(row: Row) -> Row:
    return {name: _number(value) for name, value in row.items()}
