"""Draw figures of recorded results: learning curves and label efficiency. Equal variants give equal bytes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import scipy.optimize
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cuelearner_jax.guides import registry
from cuelearner_jax.report.escaping import one_line
from cuelearner_jax.report.statistics import Curve, Interval
from cuelearner_jax.report.variants import Variant, guidance_name

# Palette of Okabe and Ito, distinguishable with any colour vision, without the colours of the package's kinds.
OTHER_COLOURS = ("#E69F00", "#56B4E9", "#B8A600", "#000000")
AXIS_NAMES = {"reward": "reward a step", "success": "success rate", "collision": "collision rate"}
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "cuelearner",  # with no date, so that equal figures give equal bytes
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "legend.frameon": False,
    "text.parse_math": False,  # dollar signs in a name are not mathematics
}
DWARFED = 5.0  # the first evaluation is off the scale if it would make the span this many times larger
APART = 0.09  # least distance of two labelled ticks, as a share of the axis over label budgets


def draw_curves(variants: Sequence[Variant], title: str, metric: str) -> Figure:
    """Draw learning curves: interquartile means with interval bands, each curve named at its right end."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8, 4.5), layout="constrained")
        axes = figure.add_subplot()
        colours = colours_of(variants)
        for variant, colour in zip(variants, colours, strict=True):
            steps, estimate, lower, upper = variant.curve
            marker = "o" if len(steps) == 1 else ""
            axes.fill_between(steps, lower, upper, color=colour, alpha=0.18 if len(variants) < 6 else 0.12, linewidth=0)
            axes.plot(steps, estimate, color=colour, linewidth=1.8, marker=marker, solid_capstyle="round")
        end = max(int(variant.curve.steps[-1]) for variant in variants)
        axes.set_xlim(0, max(end, 1))
        left_out = _scale(axes, variants)
        _mark_failed(axes, variants, colours)
        axes.set_xlabel("environment steps of a seed")
        axes.set_ylabel(axis_name(metric))
        axes.xaxis.set_major_formatter(ticker.EngFormatter(sep=""))
        axes.set_title(one_line(title), fontweight="bold", fontsize=11, pad=20)
        note = f"interquartile mean over seeds, band: its 95% bootstrap interval{left_out}"
        axes.text(0, 1.025, note, transform=axes.transAxes, color="#595959", fontsize=9)
        _name_ends(axes, variants, colours)
    return figure


def draw_label_efficiency(variants: Sequence[Variant], title: str, metric: str) -> Figure:
    """Draw interquartile means against the label budget; a kind without labels is a horizontal band."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8, 4.2), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        shared = min(int(variant.curve.steps[-1]) for variant in variants)
        last = [_at(variant.curve, shared) for variant in variants]
        draw_budgets(left, variants, last, f"at step {shared:,}, reached by all")
        draw_budgets(right, variants, [variant.mean for variant in variants], "mean over the curve")
        left.set_ylabel(axis_name(metric))
        handles, names = left.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=min(5, len(names)))
        figure.suptitle(one_line(title), x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _at(known: Curve, step: int) -> Interval:
    """Return the last evaluation up to a step, so that no curve is compared beyond its end."""
    place = max(0, int(np.searchsorted(known.steps, step, side="right")) - 1)
    return Interval(*(values[place] for values in known[1:]))


def draw_budgets(axes: Axes, variants: Sequence[Variant], intervals: Sequence[Interval], panel: str) -> None:
    """Draw intervals against the label budget, one line per kind of guidance; a kind without labels is a level."""
    kinds = list(dict.fromkeys(variant.guidance for variant in variants))
    for place, kind in enumerate(kinds):
        colour, name = colour_of(kind), guidance_name(kind)
        pairs = zip(variants, intervals, strict=True)
        points = [(variant.labels, *at) for variant, at in pairs if variant.guidance == kind]
        for _, estimate, lower, upper in (point for point in points if not point[0]):
            axes.axhspan(float(lower), float(upper), color=colour, alpha=0.12, linewidth=0)
            axes.axhline(float(estimate), color=colour, label=name, linewidth=1.5, linestyle="--")
        if any(point[0] for point in points):
            labels, estimate, lower, upper = np.array([point for point in points if point[0]], float).T
            bars = np.nan_to_num([estimate - lower, upper - estimate])
            # All points stand on their budget's tick; caps of different widths tell intervals at one budget apart.
            axes.errorbar(labels, estimate, bars, color=colour, label=name, marker="o", capsize=3 + 2 * place)
    budgets = sorted({variant.labels for variant in variants if variant.labels})
    axes.set_xscale("log")
    axes.set_xticks(budgets, names_of(budgets))
    axes.minorticks_off()
    axes.set_xlabel("labels")
    axes.set_title(panel, fontsize=10)


def names_of(budgets: Sequence[int]) -> list[str]:
    """Return budgets as labels of a logarithmic axis; empty for a budget too near a larger one."""
    names: list[str] = []
    last, least = np.inf, APART * np.log(max(budgets) / min(budgets)) if budgets else 0.0
    for budget in reversed(budgets):
        names.append(f"{budget:,}" if last - np.log(budget) >= least else "")
        last = np.log(budget) if names[-1] else last
    return names[::-1]


def save_figure(figure: Figure, stem: Path) -> None:
    """Write `stem.png` and `stem.svg` without dates or versions."""
    with matplotlib.rc_context(STYLE):
        figure.savefig(stem.with_name(stem.name + ".png"), dpi=200, metadata={"Software": None})
        figure.savefig(stem.with_name(stem.name + ".svg"), metadata={"Date": None, "Creator": None})


def colour_of(guidance: str) -> str:
    """Return the colour of a kind of guidance; an unknown kind gets a fixed one of the other colours."""
    kind = registry.find_or_none(guidance)
    return kind.colour if kind and kind.colour else OTHER_COLOURS[sum(guidance.encode()) % len(OTHER_COLOURS)]


def colours_of(variants: Sequence[Variant]) -> list[tuple[float, float, float]]:
    """Return each variant's colour: that of its guidance, paler for smaller label budgets."""
    colours = []
    for variant in variants:
        budgets = [other.labels for other in variants if other.guidance == variant.guidance]
        pale = 0.6 * (1 - (budgets.index(variant.labels) + 1) / len(budgets))
        red, green, blue = ((1 - pale) * channel + pale for channel in to_rgb(colour_of(variant.guidance)))
        colours.append((red, green, blue))
    return colours


def _scale(axes: Axes, variants: Sequence[Variant]) -> str:
    """Set the vertical scale; return words about points beyond it.

    The first evaluation, before learning, is left out where it would compress all others to less than a fifth of the
    height: agents that still collide all the time would hide the differences between those that seldom do.
    """
    first = [_extremes([row[:1] for row in variant.curve[1:]]) for variant in variants]
    later = [_extremes([row[1:] for row in variant.curve[1:]]) for variant in variants if len(variant.curve.steps) > 2]
    if not later:
        return ""
    low, high = min(pair[0] for pair in later), max(pair[1] for pair in later)
    least, most = min(pair[0] for pair in first), max(pair[1] for pair in first)
    span = high - low
    if not 0 < DWARFED * span < max(high, most) - min(low, least):
        return ""
    axes.set_ylim(low - 0.05 * span, high + 0.05 * span)
    steps = sorted({int(variant.curve.steps[0]) for variant in variants})
    where = f"step {steps[0]:,}" if len(steps) == 1 else "the first evaluations"
    return f"; {where} (from {least:.2g} to {most:.2g}) not on the scale"


def _mark_failed(axes: Axes, variants: Sequence[Variant], colours: Sequence[tuple[float, ...]]) -> None:
    """Draw a cross for each failed lane, on its variant's curve or at the edge of the scale."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    for variant, colour in zip(variants, colours, strict=True):
        if not len(variant.failed):
            continue
        at = np.minimum(variant.failed, variant.curve.steps[-1])
        heights = np.clip(np.interp(at, variant.curve.steps, variant.curve.estimate), low, high)
        axes.plot(at, heights, "x", color=colour, markersize=8, clip_on=False)
    if any(len(variant.failed) for variant in variants):
        cross = Line2D([], [], linestyle="", marker="x", color="#595959", label="a failed seed, left out")
        axes.legend(handles=[cross], loc="best", fontsize=9)


def _extremes(rows: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the least and largest finite values; a single seed has no interval."""
    values = np.concatenate(rows)
    return float(np.nanmin(values)), float(np.nanmax(values))


def separate_heights(heights: np.ndarray, gap: float, low: float, high: float) -> np.ndarray:
    """Return heights (n,) at least a gap apart, in the order of the given ones and as near to them as possible.

    They are an isotonic regression of the heights less the gaps below them. All lie between `low` and `high`, which
    must leave room for n - 1 gaps.
    """
    order, rank = np.argsort(heights, kind="stable"), gap * np.arange(len(heights))
    moved = scipy.optimize.isotonic_regression(heights[order] - rank).x
    found = np.empty(len(heights))
    found[order] = np.clip(moved, low, high - rank[-1]) + rank
    return found


def _name_ends(axes: Axes, variants: Sequence[Variant], colours: Sequence[tuple[float, ...]]) -> None:
    """Write each curve's name to the right of the axes, ordered by the curves' ends and without overlap."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    right = axes.get_xlim()[1]
    ends = np.array([variant.curve.estimate[-1] for variant in variants])
    height = 0.055 * (high - low)  # height of a line of text with its spacing
    gap = min((high - low) / len(variants), height)
    for place, height_of_name in enumerate(separate_heights(ends, gap, low, high)):
        variant, colour = variants[place], colours[place]
        last = float(variant.curve.steps[-1])
        # The leader is dotted, since it shows no data. It is level within the axes, so that the leaders keep the
        # order of the names and never cross.
        leader = {"color": colour, "linewidth": 1, "linestyle": ":", "clip_on": False}
        if last < right:
            axes.plot([last, right], [ends[place]] * 2, **leader)
            axes.plot([last], [ends[place]], color=colour, marker="o", markersize=4)
        axes.plot([1, 1.025], [ends[place], height_of_name], transform=axes.get_yaxis_transform(), **leader)
        axes.text(
            1.03,
            height_of_name,
            variant.name,
            transform=axes.get_yaxis_transform(),
            color=tuple(0.85 * channel for channel in colour),
            fontsize=10 * gap / height,
            va="center",
        )


def axis_name(metric: str) -> str:
    """Return an axis label for a metric."""
    return AXIS_NAMES.get(metric, one_line(metric.replace("_", " ")))
