"""Curves of recorded adaptation over labels and steps: their points, their figure, and when a gain is made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from _adaptation_tables import GAIN, Line, first_reaching, matched, name_of, share
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from cuelearner_jax.report.figures import colour_of, save_figure

CURVES = ("relative", "residual", "dcoach", "finetuning")
COLOURS = {"residual": "#E69F00", "finetuning": "#4d4d4d"}

# method and variant -> labels or steps, values (bases, label seeds, points)
Points = dict[tuple[str, str], tuple[list[int], np.ndarray]]


def curve_points(known: Sequence[Line], metric: str, whole: Line | None = None) -> Points:
    """Return what methods reach over labels or steps, from not adapted on, over the bases that all have."""
    start = [line for line in known if line.method == "none"]
    if not start:
        return {}
    found: Points = {}
    made = dict.fromkeys((line.method, line.variant) for line in known if line.method in CURVES)
    for kind in sorted(made, key=lambda kind: CURVES.index(kind[0])):
        own = [line for line in known if (line.method, line.variant) == kind]
        own = own if any(line.after == 0 for line in own) else [*start, *own]
        if len(own) < 2:
            continue
        base = whole or start[0]
        columns = [
            share(line, whole) if whole else matched(line, base, metric)[0]
            for line in sorted(own, key=lambda line: line.after)
        ]
        if len({len(column) for column in columns}) == 1:
            found[kind] = sorted(line.after for line in own), np.stack(np.broadcast_arrays(*columns), axis=-1)
    return found


GAIN_HEADER = ["method", f"{GAIN:.0%} of its own gain", f"{GAIN:.0%} of the gain of relative labels"]


def gain_cells(points: Points) -> list[list[str]]:
    """Return when each method has made its own gain, and that of relative labels."""
    if (CURVES[0], "") not in points:
        return []
    reference = points[CURVES[0], ""][1][..., [0, -1]]
    rows = []
    for (method, variant), (labels, values) in points.items():
        if len(values) != len(reference):
            continue
        mine, theirs = (first_reaching(values, labels, reference, own) for own in (True, False))
        unit = "steps" if method == "finetuning" else "labels"
        own = "never gained" if not np.isfinite(mine.estimate) else f"{mine.in_words(labels[-1])} {unit}"
        rows.append([name_of(method, variant), own, f"{theirs.in_words(labels[-1])} {unit}"])
    return rows


def figure(curves: dict[str, Points], stem: Path, ylabel: str, level: tuple[float, str] | None) -> None:
    """Draw curves over labels and steps on one logarithmic axis, a panel a world."""
    drawn = Figure(figsize=(max(3.2 * len(curves) + 0.6, 7.6), 3.4), layout="constrained")
    for axes, (world, points) in zip(drawn.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True):
        for (method, variant), (labels, values) in points.items():
            low, middle, high = np.quantile(values.mean(1), [0.25, 0.5, 0.75], axis=0)
            colour = COLOURS.get(method) or colour_of(method)
            x = np.maximum(labels, 10)  # the first point, of no labels, at the left end
            style = {"color": colour, "linestyle": "--" if variant else "-", "marker": "o", "markersize": 3}
            axes.plot(x, middle, label=name_of(method, variant), **style)
            axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        if level:
            axes.axhline(level[0], color="#999999", linestyle="--", linewidth=1, label=level[1])
        axes.set(xscale="log", title=world.replace("_", " "), xlabel="labels, or steps of fine-tuning")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1_000:g}k" if value >= 1_000 else f"{value:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    drawn.axes[0].set_ylabel(ylabel)
    handles, names = drawn.axes[0].get_legend_handles_labels()
    columns = min(len(names), 5 if len(curves) > 1 else 3)
    drawn.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)
    save_figure(drawn, stem)
