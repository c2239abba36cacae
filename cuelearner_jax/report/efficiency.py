"""Label efficiency: steps to a level, and how many labels of one kind equal those of another, with intervals.

The steps to a level are the interquartile mean over seeds of the step at which a seed's nondecreasing fit reaches it.
A level is held fixed. A curve that ends below the level is right-censored (`Range`): its steps are "more than the
last", which ratios and intervals carry on as a bound, never as a number. Intervals are those of `Variant.samples`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cuelearner_jax.errors import UserError
from cuelearner_jax.report import statistics
from cuelearner_jax.report.tables import GAIN, Row, identity, level_of, markdown, markdown_table, unguided_of
from cuelearner_jax.report.variants import Variant

Samples = Float[np.ndarray, "samples"]  # the estimate, then the draws of its bootstrap


@dataclass(frozen=True)
class Question:
    """Question that is asked about label budgets."""

    level: float | None = None
    """Value of the metric to be reached (default: see --level-at). Of several tasks: the value whose normalised score
    is 1 (default: the best variant's mean over the curve)."""
    level_at: int | None = None
    """Without --level: step of the unguided agents whose value is the level (default: 90% of their gain over the
    curve)."""
    reference: str | None = None
    """Kind of guidance with whose labels those of others are compared (default: each)."""


class Efficiency(NamedTuple):
    """Label efficiency of recorded curves."""

    level: float
    origin: str  # of the level, in words
    tables: dict[str, list[Row]]  # by file name


class Range(NamedTuple):
    """Range of a quantity; its ends are equal where it is known exactly."""

    lower: Samples
    upper: Samples


class Sampled(NamedTuple):
    """A variant with the samples of its mean over the curve and of its steps to the level."""

    variant: Variant
    areas: Samples
    steps: Range


def _sampled(variant: Variant, level: float, sign: float) -> Sampled:
    def numbers(curves: np.ndarray) -> np.ndarray:
        steps = statistics.steps_to_level(variant.curve.steps, sign * curves, sign * level)
        return np.concatenate([variant.area(curves)[..., None], steps], axis=-1)

    areas, lower, upper = variant.samples(numbers).T
    return Sampled(variant, areas, Range(lower, upper))


def ratio_bounds(above: Range, below: Range) -> Range:
    """Return the bounds of the ratio of two non-negative quantities; 0 to infinity for 0 over 0."""

    def divided(numerator: Samples, denominator: Samples, otherwise: float) -> Samples:
        unknown = ((numerator == 0) & (denominator == 0)) | (np.isinf(numerator) & np.isinf(denominator))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(unknown, otherwise, numerator / denominator)

    return Range(divided(above.lower, below.upper, 0.0), divided(above.upper, below.lower, np.inf))


def labels_for(budgets: np.ndarray, areas: Float[np.ndarray, "samples budgets"], target: Samples) -> Range:
    """Return the labels at which areas under the curve, nondecreasing in the budget, first reach the target.

    Areas lie on straight lines over the logarithm of the labels between two budgets. Beyond the budgets only a bound is
    known: more than the largest budget, or no more than the smallest.
    """
    at = statistics.step_at_level(np.log(budgets), areas, target)
    first, exact = at == np.log(budgets[0]), np.where(np.isinf(at), at, np.minimum(np.exp(at), float(budgets[-1])))
    return Range(np.where(first, 0.0, np.minimum(exact, float(budgets[-1]))), np.where(first, float(budgets[0]), exact))


def _columns(name: str, samples: Range, *own: Sampled) -> Row:
    """Return the columns of an estimate: value or bounds, and an interval where all variants have several seeds."""
    low, high = float(samples.lower[0]), float(samples.upper[0])
    row: Row = {name: low} if low == high else {f"{name}_above": low, f"{name}_below": high}
    if all(len(each.variant.seeds) > 1 for each in own):
        ends = statistics.censored_interval(np.stack(samples, -1)[1:])
        row |= {f"{name}_lower": ends[0], f"{name}_upper": ends[1]}
    return row


def efficiency_of(variants: Sequence[Variant], question: Question, lower_is_better: bool = False) -> Efficiency:
    """Return the label efficiency of the variants of one task and metric."""
    sign = -1.0 if lower_is_better else 1.0
    kinds = {variant.guidance for variant in variants if variant.labels}
    if question.reference is not None and question.reference not in kinds:
        there = ", ".join(sorted(kinds)) or "none"
        raise UserError(f"--reference {question.reference}: no results with its labels; there are {there}")
    level, origin = _level(variants, question)
    every = {id(variant): _sampled(variant, level, sign) for variant in variants}
    rows: list[Row] = []
    asking: dict[str, dict[str, list[Sampled]]] = {}  # by run and kind
    for variant in variants:
        own, unguided = every[id(variant)], unguided_of(variant, variants)
        if variant.guidance == "none" and sign * (level - variant.curve.estimate[0]) <= 0:
            raise UserError(
                f"the level {level:.3g} is no better than what {variant.name} begins with "
                f"({variant.curve.estimate[0]:.3g}): give --level or a later --level-at"
            )
        rows.append(_row(own, None if unguided is None or unguided is variant else every[id(unguided)]))
        if variant.labels:
            asking.setdefault(variant.run, {}).setdefault(variant.guidance, []).append(own)
    equal = [row for run, kinds in asking.items() for row in _equal_area(run, kinds, question.reference, sign)]
    return Efficiency(level, origin, {"efficiency": rows} | ({"equal_area": equal} if equal else {}))


def _level(variants: Sequence[Variant], question: Question) -> tuple[float, str]:
    """Return the level and its origin. Raises UserError if there is none."""
    if question.level is not None:
        return question.level, "given"
    if (unguided := next((variant for variant in variants if variant.guidance == "none"), None)) is None:
        raise UserError("no results of unguided agents, whose level would be the one to reach: give --level")
    if (at := question.level_at) is None:
        return level_of(unguided), f"{GAIN:.0%} of the gain of {unguided.name} over the curve"
    if at not in (steps := unguided.curve.steps):
        raise UserError(f"--level-at {at}: {unguided.name} has no such step, but {', '.join(map(str, steps))}")
    return float(unguided.curve.estimate[np.flatnonzero(steps == at)[0]]), f"that of {unguided.name} at step {at:,}"


def _row(own: Sampled, unguided: Sampled | None) -> Row:
    """Return a variant's row of `efficiency.csv`; ratios and differences are to the unguided agents'."""
    variant = own.variant
    row: Row = {**identity(variant), "seeds": len(variant.seeds)}
    guide = () if variant.guide is None else (statistics.interquartile_mean(variant.guide),)  # its episodes: not kept
    for name, of in (("guide", guide), ("mean", variant.mean)):
        ends = zip(("", "_lower", "_upper"), of, strict=False)
        row |= {name + end: float(value) for end, value in ends if np.isfinite(value)}
    row |= _columns("steps_to_level", own.steps, own) | {"reached": float(np.isfinite(own.steps.upper[1:]).mean())}
    if unguided is None:
        return row
    row["against"] = unguided.variant.name
    mean, other, difference = (Range(each, each) for each in (own.areas, unguided.areas, own.areas - unguided.areas))
    comparisons = {"mean_difference": difference, "mean_ratio": ratio_bounds(mean, other)}
    comparisons["steps_ratio"] = ratio_bounds(own.steps, unguided.steps)
    if min(own.areas.min(), unguided.areas.min()) < 0:  # the ratio of negative means is larger for the worse one
        del comparisons["mean_ratio"]
    for name, bounds in comparisons.items():
        row |= _columns(name, bounds, own, unguided)
    return row


def _equal_area(run: str, asking: dict[str, list[Sampled]], reference: str | None, sign: float) -> list[Row]:
    """Return the labels of one kind that give the mean over the curve of another's (or the reference's) budgets."""
    budgets = {kind: np.array([each.variant.labels for each in own]) for kind, own in asking.items()}
    areas = {kind: sign * np.stack([each.areas for each in own], axis=1) for kind, own in asking.items()}
    fitted = {kind: statistics.nondecreasing(samples) for kind, samples in areas.items()}
    rows = []
    for base in asking if reference is None else [kind for kind in asking if kind == reference]:
        for place, labels in enumerate(budgets[base].tolist()):
            for kind in (kind for kind in asking if kind != base):
                needed = labels_for(budgets[kind], fitted[kind], fitted[base][:, place])
                both = (*asking[base], *asking[kind])
                row: Row = {"run": run} if run else {}
                row |= {"reference": base, "reference_labels": labels, "mean": float(sign * fitted[base][0, place])}
                row |= {"guidance": kind} | _columns("labels", needed, *both)
                rows.append(row | _columns("labels_ratio", Range(*(bound / labels for bound in needed)), *both))
    return rows


def cell(row: Row, name: str, form: str) -> str:
    """Return a quantity with its interval: `0.62 [0.54, 0.71]`, `above 1.40 [1.30, no bound]`, or nothing.

    A ratio whose interval has no bound above and does not exclude 1 is "not told apart".
    """
    value, low, high, lower, upper = (row.get(name + end) for end in ("", "_above", "_below", "_lower", "_upper"))
    if (value is None and low is None) or value == np.inf:
        return ""
    if name.endswith("_ratio") and upper == np.inf and float(lower or 0) < 1:
        return "not told apart"
    text_of = lambda number: form.format(number) if number != np.inf else "no bound"  # noqa: E731
    if value is not None:
        text = text_of(value)
    elif high == np.inf:
        text = f"above {text_of(low)}" if low else "not known"
    else:
        text = f"{text_of(low)} to {text_of(high)}" if low else f"at most {text_of(high)}"
    return text if lower is None else f"{text} [{text_of(lower)}, {text_of(upper)}]"


def section(efficiency: Efficiency) -> list[str]:
    """Return the section of a report: a table of the variants, and tables of labels."""
    lines = ["", "## Label efficiency", "", f"The level is {efficiency.level:.3f}: {markdown(efficiency.origin)}."]
    forms = {
        "efficiency": {
            "guide alone": ("guide", "{:.3f}"),
            "steps to the level": ("steps_to_level", "{:,.0f}"),
            "ratio of steps to unguided": ("steps_ratio", "{:.2f}"),
            "mean over the curve": ("mean", "{:.3f}"),
            "ratio of means to unguided": ("mean_ratio", "{:.2f}"),
        },
        "equal_area": {
            "labels for an equal mean over the curve": ("labels", "{:,.0f}"),
            "ratio to reference": ("labels_ratio", "{:.2f}"),
        },
    }
    for name, table in efficiency.tables.items():
        keys = [key for key in ("run", "reference", "reference_labels", "guidance") if key in table[0]]
        keys += ["labels"] if name == "efficiency" else []
        header = [key.replace("_", " ") for key in keys] + [*forms[name]]
        columns = forms[name].values()
        cells = [[*(markdown(row[key]) for key in keys), *(cell(row, *of) for of in columns)] for row in table]
        lines += ["", *markdown_table(header, cells)]
    return lines
