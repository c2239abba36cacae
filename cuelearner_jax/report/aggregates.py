"""Aggregates over tasks, as Agarwal et al. (2021, arXiv 2108.13264) recommend: profiles and interquartile means.

A run's score is its mean over the curve, normalised by task: 0 for the interquartile mean of the unguided agents, 1
for that of the task's best variant, or for `--level`. Both are held fixed. Intervals draw each task's seeds apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cuelearner_jax.errors import UserError
from cuelearner_jax.report.statistics import Curve, Interval, improvement, interquartile_mean
from cuelearner_jax.report.tables import Row, identity, markdown, markdown_table, unguided_of
from cuelearner_jax.report.variants import Variant

Scores = Float[np.ndarray, "samples runs"]  # of the real seeds, then of the draws of their bootstrap
THRESHOLDS = np.linspace(-0.25, 1.25, 61)
NOTE = (
    "A run's score is its mean over the curve. In each task 0 is the unguided agents' interquartile mean, 1 is {}. All "
    "runs have equal weight. In brackets: 95% bootstrap intervals over seeds and episodes, drawn in each task, with 0 "
    "and 1 held fixed: to tell a kind from the unguided agents, take the probability of improvement (a mean over "
    "tasks), not an interval that excludes 0. The median is that of the tasks' means, the optimality gap the mean "
    "shortfall from 1."
)
STATISTICS: dict[str, Callable[[list[Scores]], np.ndarray]] = {
    "interquartile mean": lambda tasks: interquartile_mean(np.concatenate(tasks, axis=1), axis=1),
    "median": lambda tasks: np.median([scores.mean(axis=1) for scores in tasks], axis=0),
    "mean": lambda tasks: np.concatenate(tasks, axis=1).mean(axis=1),
    "optimality gap": lambda tasks: np.maximum(1 - np.concatenate(tasks, axis=1), 0).mean(axis=1),
}
IMPROVEMENT = "probability of improvement"


class Aggregates(NamedTuple):
    """Aggregates of the variants that all tasks have."""

    each: list[tuple[Variant, Curve, dict[str, Interval]]]  # without a task; share of runs above `THRESHOLDS`; numbers
    ends: dict[str, tuple[float, float]]  # by task: the metric at the scores 0 and 1
    missing: list[str]  # a line for each variant that some tasks lack

    @property
    def tables(self) -> dict[str, list[Row]]:
        """The tables by file name."""
        aggregates, profiles = [], []
        for variant, profile, numbers in self.each:
            columns = {name.replace(" ", "_"): of for name, of in numbers.items()}
            ends = {name + end: of[i] for name, of in columns.items() for i, end in enumerate(("", "_lower", "_upper"))}
            aggregates.append(identity(variant) | {name: float(value) for name, value in ends.items()})
            for point in np.transpose(profile).tolist():
                profiles.append(identity(variant) | dict(zip(("score", "share", "lower", "upper"), point, strict=True)))
        return {"aggregates": aggregates, "profiles": profiles}


def aggregates_of(variants: Sequence[Variant], level: float | None, lower_is_better: bool) -> Aggregates:
    """Return the aggregates of variants of several tasks. Raises UserError where a task has no 0 or no 1."""
    sign, tasks = -1.0 if lower_is_better else 1.0, list(dict.fromkeys(one.task for one in variants))
    ends = {task: _ends([one for one in variants if one.task == task], level, sign) for task in tasks}
    each: dict[tuple[str, str, int], list[Variant]] = {}
    for one in variants:
        each.setdefault((one.run, one.guidance, one.labels), []).append(one)
    if not (shared := [own for own in each.values() if len(own) == len(tasks)]):
        raise UserError(f"{', '.join(tasks)} share no guidance with equal labels: report each task by itself")
    names = [replace(own[0], task="").name for own in each.values() if own not in shared]
    missing = [f"{name}: not in all tasks, so not among the aggregates" for name in names]
    if len({one.run for one in variants}) > 1 and (unguided := unguided_of(variants[0], variants)):
        missing.append(f"scores of all settings are 0 for the unguided agents of {unguided.run}")
    return Aggregates([_aggregate(own, variants, ends) for own in shared], ends, missing)


def _ends(variants: list[Variant], level: float | None, sign: float) -> tuple[float, float]:
    """Return the values of the metric at the scores 0 and 1 of a task."""
    task, unguided = variants[0].task, unguided_of(variants[0], variants)
    if unguided is None:
        raise UserError(f"{task} has no unguided agents, whose score would be 0: add a run with --guidance none")
    zero, best = float(unguided.mean.estimate), sign * max(sign * float(one.mean.estimate) for one in variants)
    if sign * ((one := best if level is None else level) - zero) <= 0:
        no_better = f"{one:.3g} in {task} is no better than its unguided agents, {zero:.3g}"
        raise UserError(f"{no_better}: give a better --level, another --metric, or report each task by itself")
    return zero, one


def _aggregate(
    own: list[Variant], variants: Sequence[Variant], ends: dict[str, tuple[float, float]]
) -> tuple[Variant, Curve, dict[str, Interval]]:
    """Return the profile and the numbers of one variant of each task."""

    def scores(variant: Variant) -> Scores:
        zero, one = ends[variant.task]
        return (variant.samples(variant.area, lambda values, axis: values) - zero) / (one - zero)

    def spread(samples: np.ndarray, of: Sequence[Variant] = own) -> Interval:
        ends = np.quantile(samples[1:], [0.025, 0.975], axis=0)
        return Interval(samples[0], *(ends if min(len(one.seeds) for one in of) > 1 else ends + np.nan))

    tasks = [scores(one) for one in own]
    numbers = {name: spread(of(tasks)) for name, of in STATISTICS.items()}
    if own[0].guidance != "none":
        without = [unguided_of(one, variants) or one for one in own]
        pairs = zip(tasks, map(scores, without), strict=True)
        numbers[IMPROVEMENT] = spread(np.mean([improvement(*pair) for pair in pairs], axis=0), [*own, *without])
    above = [(np.concatenate(tasks, axis=1) > score).mean(axis=1) for score in THRESHOLDS]
    profile = Curve(THRESHOLDS, *spread(np.stack(above, axis=-1)))
    return replace(own[0], task="", failed=own[0].failed[:0]), profile, numbers


def section(over: Aggregates, level: float | None) -> list[str]:
    """Return the section of a report: a table of the aggregates, and how scores are normalised."""
    names = [*STATISTICS, IMPROVEMENT]
    each = [(identity(variant), numbers) for variant, _, numbers in over.each]
    rows = [[*map(markdown, own.values()), *(numbers.get(name, "") for name in names)] for own, numbers in each]
    note = NOTE.format("its best variant's" if level is None else "that of `--level`")
    ends = [f"- {markdown(task)}: 0 is {zero:.3f}, 1 is {one:.3f}" for task, (zero, one) in over.ends.items()]
    return ["", "## Over tasks", "", *markdown_table([*each[0][0], *names], rows), "", note, "", *ends]
