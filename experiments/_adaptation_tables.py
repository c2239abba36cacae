"""Tables of recorded adaptation: what methods reach, by number of labels or steps."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _adaptation import SCHEMA, UNCHANGED, Study
from _adaptation_methods import JUDGED, UNREWARDED

from cuelearner_jax.report.statistics import drawn, interquartile_mean, interval_of_groups
from cuelearner_jax.storage import table as tables

NAMES = {
    "none": "not adapted",
    "teacher": "the teacher itself, within the bound",
    "relative": "relative labels",
    "intent": "relative labels, read as intent",
    "reading": "relative labels, read as intervals",
    "calibration": "relative labels, read as evidence of what changed",
    "residual": "residual, optimal corrections",
    "dcoach": "deep COACH",
    "finetuning": "RL fine-tuning",
}
BY_LABELS = "judged by labels"  # a variant: held-out answers say whether a model is used
GAIN = 0.95  # of a gain, after how many labels it is asked for
Row = dict[str, Any]


def name_of(method: str, variant: str) -> str:
    """Return a method's name as tables and figures show it."""
    return NAMES[method] + (f" ({variant})" if variant else "")


class Line(NamedTuple):
    """A method after some labels or steps."""

    method: str
    variant: str
    after: int  # labels, or steps of fine-tuning
    bases: np.ndarray  # (bases,), ascending
    columns: dict[str, np.ndarray]  # metrics (bases, label seeds)
    path: str  # of the piece, in its study
    command: str  # that ran it

    @property
    def name(self) -> str:
        """The line's name in tables."""
        return name_of(self.method, self.variant)


def read(folder: Path) -> list[Row]:
    """Return the rows of all finished pieces of a task; none where the folder is missing."""
    rows = []
    for file in sorted(folder.rglob(SCHEMA.parquet)):
        rows += tables.read(file, SCHEMA).to_pylist()
    return rows


def lines(rows: Sequence[Row], world: str, split: str = "validation", least: float = 0.0) -> list[Line]:
    """Return the lines of a world, in the order of `NAMES`.

    `least`: base agents that earn less in the unchanged world, on tuning episodes, are left out.
    """
    alone = [row for row in rows if row["world"] == UNCHANGED and row["split"] == "tuning"]
    poor = {row["base"] for row in alone if row["reward"] < least}
    found: dict[tuple, list[Row]] = {}
    for row in rows:
        if row["world"] == world and row["split"] == split and row["base"] not in poor:
            settings = (row.get("learning_rate"), row.get("noise_deg")) if split == "tuning" else ()
            found.setdefault((row["method"], row["variant"], row["labels"] or row["steps"], settings), []).append(row)
    result = []
    for (method, variant, after, settings), several in found.items():
        own = sorted(several, key=lambda row: (row["base"], row.get("label_seed") or 0))
        bases = np.unique([row["base"] for row in own])
        numbers = [name for name, value in own[0].items() if isinstance(value, float)]
        columns = {name: np.array([np.nan if row[name] is None else row[name] for row in own]) for name in numbers}
        columns = {name: values.reshape(len(bases), -1) for name, values in columns.items()}
        told = [variant] * bool(variant) + [f"{value:g}" for value in settings if value is not None]
        path = f"{world}/{method}-{variant}" if variant else f"{world}/{method}"
        command = own[0].get("command") or ""
        apart = {name.removeprefix(UNREWARDED): columns.pop(name) for name in numbers if name.startswith(UNREWARDED)}
        result.append(Line(method, ", ".join(told), after, bases, columns, path, command))
        if apart:
            result.append(Line(method, ", ".join([*told, BY_LABELS]), after, bases, apart, path, command))
    order = list(NAMES)
    return sorted(result, key=lambda line: (order.index(line.method), line.variant, line.after))


def spread(values: np.ndarray, digits: int = 3) -> str:
    """Return the interquartile mean over bases with its interval; `values` (bases, label seeds), or (bases,)."""
    values = values.reshape(len(values), -1)
    own = values[np.isfinite(values).all(-1)]
    if not len(own):
        return "none"
    found = interval_of_groups(own)
    estimate = f"{float(found.estimate):.{digits}f}"
    if len(own) == 1:
        return estimate
    return f"{estimate} [{float(found.lower):.{digits}f}, {float(found.upper):.{digits}f}]"


def percent(values: np.ndarray) -> str:
    """Return the interquartile mean of shares with its interval, in percent."""
    return spread(100 * values, 1)


def matched(line: Line, other: Line, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a metric of two lines over the bases that both have."""
    _, mine, its = np.intersect1d(line.bases, other.bases, return_indices=True)
    return line.columns[name][mine], other.columns[name][its]  # of each (bases, label seeds)


def tuned(rows: Sequence[Row], world: str) -> set[int]:
    """Return the base agents on which settings of a world were chosen."""
    return {row["base"] for row in rows if row["split"] == "tuning" and row["world"] == world}


def held_out(line: Line, name: str, bases: set[int]) -> str:
    """Return a metric over the base agents outside `bases`, in percent; empty where all are inside."""
    values = line.columns[name][~np.isin(line.bases, list(bases))]
    return percent(values) if len(values) else ""


PERIOD_S = 0.2  # of a step in navigation


def rewarded_steps(line: Line, start: Line, study: Study) -> int | None:
    """Return the environment steps an agent whose rewards or outcomes a method used; None where unknown.

    Of fine-tuning those it learned from. Of a model of labels those by which its use was decided, on tuning episodes:
    of the base and of the model within each bound that was tried. Where an outcome decided, an episode counts until its
    end. Rows that do not tell it are counted here, with episodes as long as those of validation.
    """
    if line.method == "finetuning":
        return line.after
    if line.variant.endswith(BY_LABELS):
        return 0
    if "rewarded_steps" in line.columns:
        return round(int(line.columns["rewarded_steps"].mean()), -3)
    if "used" not in line.columns or not line.command:
        return None
    words = [*line.command.split(), ""]
    known = dict(itertools.pairwise(words))
    scale = study.scales[known.get("--scale", "paper")]
    episodes = min(int(known.get("--envs", scale.envs)), JUDGED)
    tried = 1 + next((len(piece.judge_bounds) for piece in study.pieces if piece.path == line.path), 0)
    if "duration" not in line.columns:
        return episodes * scale.steps * (1 + tried)
    lengths = [float(np.mean(of.columns["duration"])) / PERIOD_S for of in (start, line)]
    return round(int(episodes * (lengths[0] + tried * lengths[1])), -3)


def recovered(now: np.ndarray, before: np.ndarray, whole: np.ndarray) -> str:
    """Return the share of a loss that has come back, in percent: a ratio of interquartile means over the same agents.

    Args:
        now, before, whole: (bases, label seeds or 1) after, not adapted, and what could come back.
    """
    draws = drawn(*now.shape)
    several = (np.broadcast_to(values, now.shape) for values in (now, before, whole))
    after, start, most = (interquartile_mean(values[draws].mean(-1), axis=1) for values in several)
    lost = most - start
    if lost[0] <= 0:
        return ""
    shares = 100 * np.divide(after - start, lost, out=np.full(len(lost), np.inf), where=lost > 0)
    ends = np.quantile(shares[1:], [0.025, 0.975], method="nearest")
    middle, lower, upper = (str(round(value)) if np.isfinite(value) else "no bound" for value in (shares[0], *ends))
    return f"{middle} [{lower}, {upper}]"


def share(line: Line, whole: Line) -> np.ndarray:
    """Return the reward as a share of the same base agent's in the unchanged world."""
    own, before = matched(line, whole, "reward")
    return own / np.maximum(before, 1e-9)


class Reached(NamedTuple):
    """Labels or steps after which a level is reached."""

    estimate: float  # infinite: it is not
    lower: float
    upper: float

    def in_words(self, last: int) -> str:
        """Return the number with its interval as a cell; `last`: labels or steps of the longest run."""

        def number(value: float) -> str:
            return f"{value:,.0f}" if np.isfinite(value) else f"above {last:,}"

        return f"{number(self.estimate)} [{number(self.lower)}, {number(self.upper)}]"


def first_reaching(curves: np.ndarray, after: Sequence[int], reference: np.ndarray, own: bool) -> Reached:
    """Return the labels or steps after which a method's curve has made `GAIN` of a gain.

    Args:
        curves: (bases, label seeds, points) of the method, the first at 0 labels or steps.
        after: labels or steps of the points.
        reference: (bases, label seeds, 2): another method's first and last point; its gain is meant unless the `own`
            one is.
        own: is the method's own gain meant?
    """
    means = interquartile_mean(curves[drawn(*curves.shape[:2])].mean(2), axis=1)
    others = interquartile_mean(reference[drawn(*reference.shape[:2])].mean(2), axis=1)
    gains = means[:, [0, -1]] if own else others
    found = [
        _crossing(curve, after, first + GAIN * (last - first)) if last > first else np.inf
        for curve, (first, last) in zip(means, gains, strict=True)
    ]
    lower, upper = np.quantile(found[1:], [0.025, 0.975], method="nearest")
    return Reached(found[0], float(lower), float(upper))


def _crossing(curve: np.ndarray, after: Sequence[int], level: float) -> float:
    """Return where straight lines between points first reach a level."""
    at = np.flatnonzero(curve >= level)
    if not len(at):
        return np.inf
    if at[0] == 0:
        return float(after[0])
    low, high = at[0] - 1, at[0]
    part = (level - curve[low]) / (curve[high] - curve[low])
    return float(after[low] + part * (after[high] - after[low]))
