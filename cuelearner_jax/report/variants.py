"""Group rows of results into variants: all seeds with one kind of guidance and one label budget."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float, Int

from cuelearner_jax.errors import UserError, one_line
from cuelearner_jax.guides import registry
from cuelearner_jax.report import statistics
from cuelearner_jax.report.statistics import Curve, Interval, interquartile_mean, interval, mean_over_curve
from cuelearner_jax.runs import failures
from cuelearner_jax.storage import results

PathLike = str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class Variant:
    """All seeds with one kind of guidance and one label budget, at the steps that all of them have reached."""

    guidance: str
    labels: int
    seeds: Int[np.ndarray, "seeds"]
    steps: Int[np.ndarray, "steps"]
    values: Float[np.ndarray, "seeds steps"]
    # steps by which the failed lanes had failed; nothing else here is about these lanes
    failed: Int[np.ndarray, "lanes"] = field(default_factory=lambda: np.array([], int))
    run: str = ""  # name of the group of runs and of their setting, where groups are reported separately
    guide: Float[np.ndarray, "guides"] | None = None  # metric of each seed's guide alone, where it was measured
    episodes: int = 0  # of an evaluation, at least; 0: the runs, of an earlier version, keep none
    each: Float[np.ndarray, "seeds groups steps"] | None = None  # values of groups of episodes; None: of one group
    span: tuple[float, float] = (-np.inf, np.inf)  # first and last step that the curves of a task's variants share
    task: str = ""  # where there are several
    stream: str = ""  # name whose variants draw their seeds together, where that is not the task

    @cached_property
    def curve(self) -> Curve:
        """The interval at each evaluation."""
        return Curve(self.steps, *interval(self.values, self.groups))

    @cached_property
    def mean(self) -> Interval:
        """The mean over the curve, see `area`."""
        return interval(self.area(self.values), self.area(self.groups))

    @property
    def groups(self) -> Float[np.ndarray, "seeds groups steps"]:
        """The values of groups of episodes, of a single group where none are kept."""
        return self.values[:, None] if self.each is None else self.each

    def area(self, curves: Float[np.ndarray, "*seeds steps"]) -> Float[np.ndarray, "*seeds"]:
        """Return the mean of each curve over the span that the task's variants share."""
        return mean_over_curve(self.steps, curves, self.span)

    def samples(
        self,
        of: Callable[[np.ndarray], np.ndarray] = lambda curves: curves,
        mean: Callable[..., np.ndarray] = interquartile_mean,
    ) -> Float[np.ndarray, "samples *rest"]:
        """Return a quantity of the real seeds, and then of the draws of its bootstrap, see `statistics.resampled`.

        Variants of a task with equal seeds draw them together: their lanes start alike, so comparisons are paired.
        """
        stream = zlib.crc32((self.stream or self.task).encode() + np.asarray(self.seeds, np.int64).tobytes())
        own = mean(of(self.values), axis=0)
        return np.concatenate([own[None], statistics.resampled(self.groups, seed=stream, of=of, mean=mean)])

    @property
    def name(self) -> str:
        """The variant's name in a legend."""
        return ": ".join(filter(None, (self.place, self.short_name)))

    @property
    def place(self) -> str:
        """The task and the run, where there are several."""
        return ": ".join(filter(None, (self.task, self.run)))

    @property
    def short_name(self) -> str:
        """The guidance and the labels."""
        name = guidance_name(self.guidance)
        return f"{name}, {self.labels:,} labels" if self.labels else name


def guidance_name(guidance: str) -> str:
    """Return the name of a kind of guidance in figures, known here or not."""
    kind = registry.guides().get(guidance)
    return one_line(kind.title if kind and kind.title else guidance)


class Group(NamedTuple):
    """Results that are reported together: of one task and one setting of a sweep."""

    task: str
    name: str  # of the folder, where folders are reported separately, and of the setting; may be empty
    table: pa.Table  # the rows to report
    failed: pa.Table  # all rows of failed lanes
    invalid: int  # number of rows left out since the metric is not finite
    every: pa.Table  # all rows of the split, also of kinds and budgets that are not reported
    guides: pa.Table | None  # evaluations of the guides alone, see `storage.results`; None: there are none


def read_groups(
    folders: Sequence[PathLike], metric: str, split: str, by_run: bool, **choice: Sequence[str | int]
) -> list[Group]:
    """Read the results of folders, together or (`by_run`) each folder by itself under its name.

    `choice`: kinds of `guidance` and budgets (`labels`) to report, where not all; 0 labels are always reported.
    """
    folders_of = {Path(os.path.abspath(folder)).name: [folder] for folder in folders} if by_run else {"": folders}
    if by_run and len(folders_of) < len(folders):
        raise UserError("--by-run: several folders have the same name: give them different names")
    groups = [group for name, own in folders_of.items() for group in _groups(name, own, metric, split)]
    for column, values in choice.items():
        there = {value for group in groups for value in group.every[column].to_pylist()}
        if absent := [str(value) for value in values if value not in there]:
            names = ", ".join(map(str, sorted(there)))
            raise UserError(f"--{column} {' '.join(absent)}: no such results; there are {names}")
        if values:
            fits = pc.field(column).isin([*values, *([0] if column == "labels" else [])])
            groups = [one._replace(table=one.table.filter(fits), failed=one.failed.filter(fits)) for one in groups]
    if not any(group.table.num_rows for group in groups):
        raise UserError("no results of these kinds have one of these label budgets: give other --guidance or --labels")
    return [group for group in groups if group.table.num_rows or group.failed.num_rows or group.invalid]


def _groups(name: str, folders: Sequence[PathLike], metric: str, split: str) -> list[Group]:
    """Read the results of folders, a group for each task and setting."""
    every, guides = results.read(folders), results.read_guides(folders)
    if metric not in results.metrics(every):
        raise UserError(f"no metric {metric!r} in the results: there are {', '.join(results.metrics(every))}")
    splits = sorted(set(every["split"].to_pylist()))
    if split not in splits:
        raise UserError(f"no {split} rows in the results: there are {', '.join(splits)} rows")
    every = every.filter(pc.field("split") == split)
    keys = every.group_by(["task", *results.settings(every)]).aggregate([]).to_pylist()
    keys = sorted(keys, key=lambda key: [(value is not None, value) for value in key.values()])
    groups = [group_of(name, metric, key, rows_of(every, key), guides) for key in keys]
    if any(group.table.num_rows for group in groups):
        return groups
    if lost := "; ".join(words for group in groups if (words := failures.summary(group.failed))):
        raise UserError(f"nothing to report, {lost}: train again with other settings")
    raise UserError(f"the metric {metric!r} has no finite value in the {split} rows: choose another metric")


def rows_of(table: pa.Table, key: dict[str, Any]) -> pa.Table:
    """Return the rows with these columns' values; a column that the table lacks is null."""
    for column, value in key.items():
        if column in table.column_names:
            table = table.filter(pc.field(column).is_null() if value is None else pc.field(column) == value)
        elif value is not None:
            table = table.slice(0, 0)
    return table


def group_of(name: str, metric: str, key: dict[str, Any], every: pa.Table, guides: pa.Table | None) -> Group:
    """Return a task's and setting's results, without failed lanes and without rows whose metric is not finite."""
    setting = {option: "-" if value is None else value for option, value in key.items() if option != "task"}
    name = ", ".join(dict.fromkeys(filter(None, (name, results.setting_name(setting)))))
    marks = every[results.FAILED].to_pylist() if results.FAILED in every.column_names else []
    lanes, size = _lanes(every), len(results.LANE)
    lost = {lane for lane, is_failed in zip(lanes, marks, strict=False) if is_failed}
    rows = every.filter(pa.array([lane not in lost for lane in lanes], pa.bool_()))
    again = {lane[:size] for lane in _lanes(rows)}  # some of them failed, and were trained again in another folder
    failed = every.filter(pa.array([lane in lost and lane[:size] not in again for lane in lanes], pa.bool_()))
    table = rows.filter(pc.field(metric).is_valid())
    guides = guides and rows_of(guides, {**key, "split": every["split"][0].as_py()})
    return Group(key["task"], name, table, failed, rows.num_rows - table.num_rows, every, guides)


def _lanes(table: pa.Table) -> list[tuple[Any, ...]]:
    """Return the lane of each row; a lane that was trained again in another folder is another lane."""
    names = [name for name in (*results.LANE, "folder") if name in table.column_names]
    return list(zip(*(table[name].to_pylist() for name in names), strict=True))


def variants_of(groups: Sequence[Group], metric: str) -> list[Variant]:
    """Return the variants in the legend's order: for each group unguided first, then by guidance and label budget."""
    variants, several = [], len({group.task for group in groups}) > 1
    for group in groups:
        failed = results.failures(group.failed)
        keys = group.table.group_by(["guidance", "labels"]).aggregate([]).to_pylist()
        for kind, labels in sorted((tuple(key.values()) for key in keys), key=lambda key: (key[0] != "none", *key)):
            of_variant = (pc.field("guidance") == kind) & (pc.field("labels") == labels)
            rows = group.table.filter(of_variant)
            seeds, steps, values, each = _matrix(rows, metric, kind, labels)
            lost = np.array([step for lane, step in failed.items() if lane[:2] == (kind, labels)], int)
            guide = _guides(rows, metric, None if group.guides is None else group.guides.filter(of_variant))
            episodes = 0 if each is None else min(rows["episodes"].to_pylist())
            own = Variant(kind, labels, seeds, steps, values, lost, group.name, guide, episodes, each)
            variants.append(replace(own, task=group.task if several else ""))
    ends = {one.task: np.array([own.steps[[0, -1]] for own in variants if own.task == one.task]) for one in variants}
    spans = {task: (float(own[:, 0].max()), float(own[:, 1].min())) for task, own in ends.items()}
    return [replace(variant, span=spans[variant.task]) for variant in variants]


def _guides(rows: pa.Table, metric: str, guides: pa.Table | None) -> np.ndarray | None:
    """Return the metric of each seed's guide after its last label, (seeds,); None where none was measured."""
    column, lanes = f"guide_{metric}", set(_lanes(rows))  # without failed lanes
    latest: dict[tuple[Any, ...], float] = {}
    for table, mark in ((rows, "step"), (guides, "asked")):
        if table is None or column not in table.column_names:
            continue
        measured = table.filter(pc.field(column).is_valid()).sort_by(mark)
        pairs = zip(_lanes(measured), measured[column].to_pylist(), strict=True)
        latest |= {lane: value for lane, value in pairs if lane in lanes}
    return np.array([latest[lane] for lane in sorted(latest)]) if latest else None


def _matrix(table: pa.Table, metric: str, kind: str, labels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, Any]:
    """Return a variant's seeds (seeds,), the steps (steps,) that all seeds have, values (seeds, steps) and `each`."""
    seeds, row = np.unique(table["seed"].to_numpy(), return_inverse=True)
    steps, column = np.unique(table["step"].to_numpy(), return_inverse=True)
    count = np.zeros((len(seeds), len(steps)), int)
    np.add.at(count, (row, column), 1)
    if count.max() > 1:
        twice = seeds[(count > 1).any(axis=1)][0]
        where = sorted(set(table.filter(pc.field("seed") == int(twice))["folder"].to_pylist()))
        why = f"seed {twice} of {kind} guidance with {labels} labels occurs twice, in {' and '.join(where)}"
        raise UserError(f"{why}: leave one of them out, or name each folder and add --by-run")
    whole = (count == 1).all(axis=0)
    if not whole.any():
        advice = "wait until all have one, or leave out the run that was evaluated at other steps"
        raise UserError(f"the seeds of {kind} guidance with {labels} labels have no step in common: {advice}")
    values = np.full(count.shape, np.nan)
    values[row, column] = table[metric].to_numpy()
    lists = table[f"{metric}_each"].to_pylist() if f"{metric}_each" in table.column_names else []
    if None in lists or len(sizes := {len(entries) for entries in lists}) != 1 or not max(sizes) > 1:
        return seeds, steps[whole], values[:, whole], None  # of several versions, or of one that keeps no episodes
    each = np.zeros((*values.shape, *sizes))
    each[row, column] = np.array(lists, float)
    each += (values - each.mean(-1))[..., None]  # groups may differ by one episode in size
    return seeds, steps[whole], values[:, whole], np.moveaxis(each[:, whole], -1, 1)
