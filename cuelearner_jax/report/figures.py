"""Draw figures of recorded results: learning curves and label efficiency. Equal variants give equal bytes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import ticker
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from cuelearner_jax.errors import one_line
from cuelearner_jax.guides import registry
from cuelearner_jax.report.aggregates import Aggregates
from cuelearner_jax.report.statistics import Curve, Interval
from cuelearner_jax.report.tables import unguided_of
from cuelearner_jax.report.variants import Variant, guidance_name

# Palette of Okabe and Ito, distinguishable with any colour vision, without the colours of the package's kinds.
OTHER_COLOURS = ("#E69F00", "#56B4E9", "#B8A600", "#000000")
DASHES = ("-", (0, (5, 1.5)), (0, (2, 1.5)), (0, (6, 1.5, 1, 1.5)))  # by which equal lines are told apart
PROFILE_TEXTS = (
    "normalised score\nband: 95% bootstrap interval over seeds and episodes, drawn in each task",
    "share of runs above the score",
)
FAILED = "a failed seed, left out"
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


def draw_curves(variants: Sequence[Variant], title: str, metric: str) -> Figure:
    """Draw learning curves: interquartile means over interval bands, named in the order of their ends.

    More than four variants have a panel for each kind of guidance, beside the unguided agents. So has each of several
    tasks, with steps and values of its own.
    """
    alike = len({variant.task for variant in variants}) == 1
    groups = [list(variants)] if len(variants) <= 4 and alike else _panels(variants)
    note = "interquartile mean over seeds, band: its 95% bootstrap interval over seeds"
    note += " and episodes" if all(variant.episodes for variant in variants) else ""
    words = f"environment steps of a seed\n{note}", axis_name(metric)
    curves = [(variant, variant.curve) for variant in variants]
    return _draw_panels(groups, curves, title, words, ticker.EngFormatter(sep=""), alike)


def _draw_panels(
    groups: list[list[Variant]],
    curves: Sequence[tuple[Variant, Curve]],
    title: str,
    words: tuple[str, str],
    ticks: ticker.Formatter,
    alike: bool = True,
) -> Figure:
    """Draw a panel for each group of variants; `words` name the axes, which are `alike` in all panels or not."""
    rows, columns = -(-len(groups) // 3), min(3, len(groups))
    colours, all_curves = colours_of([variant for variant, _ in curves]), [curve for _, curve in curves]
    looks = {id(variant): (curve, colour) for (variant, curve), colour in zip(curves, colours, strict=True)}
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8, 4.5) if len(groups) == 1 else (4 * columns, 1 + 2.8 * rows), layout="constrained")
        panels = [*figure.subplots(rows, columns, sharex=alike, sharey=alike, squeeze=False).flat]
        for axes, group in zip(panels, groups, strict=False):
            place = group[-1].place if len(groups) > 1 else ""
            axes.set_title(_wrapped(place), fontsize=8)
            for number, variant in enumerate(group):
                curve, colour = looks[id(variant)]
                name = _wrapped(variant.name if variant.place != place else variant.short_name)
                _draw_curve(axes, curve, name, colour, number, variant.failed)
            there = all_curves if alike else [looks[id(variant)][0] for variant in group]
            axes.set_xlim(min(0, *(one.steps[0] for one in there)), max(1, *(one.steps[-1] for one in there)))
            axes.xaxis.set_major_formatter(ticks)
            axes.tick_params(labelbottom=True)  # also above an empty place
            lines = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
            ends = {name: -line.get_ydata()[-1] for name, line in lines.items() if name != FAILED}
            names = [*sorted(ends, key=lambda name: ends[name]), *[FAILED] * (FAILED in lines)]
            if len(groups) == 1:
                figure.legend([lines[name] for name in names], names, loc="outside right upper", fontsize=9)
            else:
                axes.legend([lines[name] for name in names], names, fontsize=7, frameon=True, edgecolor="none")
        for axes in panels[len(groups) :]:
            axes.remove()
        figure.supxlabel(words[0], fontsize=9)
        figure.supylabel(words[1], fontsize=10)
        figure.suptitle(one_line(title), x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _wrapped(name: str) -> str:
    return textwrap.fill(name.replace(",", ", ").replace(",  ", ", "), 44)


def _panels(variants: Sequence[Variant]) -> list[list[Variant]]:
    """Return the variants of each task, run and kind, after the unguided ones that they are compared with."""
    kinds: dict[tuple[str, ...], list[Variant]] = {}
    for variant in variants:
        before = unguided_of(variant, variants)
        first = [] if before is None or before is variant else [before]
        kinds.setdefault((variant.task, variant.run, variant.guidance), first).append(variant)
    others = {id(group[0]) for group in kinds.values() if len(group) > 1}
    return [group for group in kinds.values() if len(group) > 1 or id(group[0]) not in others]


def _draw_curve(axes: Any, curve: Curve, name: str, colour: Any, place: int, failed: Any = ()) -> None:
    """Draw a curve over all bands. Dashes show an equal line below; a cross marks where a failed seed ended."""
    steps, estimate, lower, upper = curve
    axes.fill_between(steps, lower, upper, color=colour, alpha=0.15, linewidth=0, zorder=2)
    look: dict[str, Any] = {"color": colour, "zorder": 3 + 0.01 * place}
    marker = "o" if len(steps) == 1 else ""
    axes.plot(steps, estimate, linewidth=1.8, linestyle=DASHES[place % 4], marker=marker, label=name, **look)
    if len(at := np.minimum(failed, steps[-1])):
        axes.plot(at, np.interp(at, steps, estimate), "x", markersize=8, clip_on=False, **look)
        axes.plot([], [], "x", color="#595959", label=FAILED)


def draw_label_efficiency(variants: Sequence[Variant], title: str, metric: str) -> Figure:
    """Draw means over the curve against the label budget; a kind without labels is a horizontal band."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7, 4.2), layout="constrained")
        axes = figure.add_subplot()
        _draw_budgets(axes, [(one, one.mean) for one in variants])
        axes.set_ylabel(f"{axis_name(metric)}, mean over the curve")
        figure.legend(loc="outside lower center", ncols=5)
        figure.suptitle(one_line(title), x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _draw_budgets(axes: Any, means: Sequence[tuple[Variant, Interval]]) -> None:
    for place, kind in enumerate(dict.fromkeys(variant.guidance for variant, _ in means)):
        look: dict[str, Any] = {"color": colour_of(kind), "label": guidance_name(kind)}
        points = np.array([(one.labels, *mean) for one, mean in means if one.guidance == kind], float)
        for _, estimate, lower, upper in points[points[:, 0] == 0]:
            axes.axhspan(lower, upper, color=look["color"], alpha=0.12, linewidth=0)
            axes.axhline(estimate, linewidth=1.5, linestyle=(3 * place, (3, 6)), **look)
        if len(points := points[points[:, 0] > 0]):
            labels, estimate, lower, upper = points.T
            bars = np.nan_to_num([estimate - lower, upper - estimate])
            # Points stand on their budget's tick; caps and dots of other sizes tell equal ones apart.
            look |= {"markersize": max(3, 9 - place), "linewidth": max(1, 2.8 - 0.3 * place)}
            axes.errorbar(labels, estimate, bars, marker="o", capsize=3 + 2 * place, **look)
    budgets = sorted({variant.labels for variant, _ in means if variant.labels})
    axes.set_xscale("log")
    axes.set_xticks(budgets, [f"{budget:,}" for budget in budgets], rotation=45)
    axes.minorticks_off()
    axes.set_xlabel("labels")


def draw_profiles(over: Aggregates) -> Figure:
    """Draw the performance profile of each variant over tasks, a panel for each setting of a sweep.

    A profile is the share of runs above each normalised score.
    """
    curves = [(variant, profile) for variant, profile, _ in over.each]
    runs = dict.fromkeys(variant.run for variant, _ in curves)
    groups = [[variant for variant, _ in curves if variant.run == run] for run in runs]
    title = f"{len(over.ends)} tasks: {', '.join(over.ends)}"
    return _draw_panels(groups, curves, title, PROFILE_TEXTS, ticker.ScalarFormatter())


def draw_suite(overs: Mapping[str, Aggregates], title: str) -> Figure:
    """Draw a row for each part of a suite: scores over label budgets, and profiles at the largest budget."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(11, 0.8 + 3.6 * len(overs)), layout="constrained")
        panels = figure.subplots(len(overs), 2, squeeze=False)
        for (left, right), (name, over) in zip(panels, overs.items(), strict=True):
            _draw_budgets(left, [(variant, numbers["interquartile mean"]) for variant, _, numbers in over.each])
            left.set_ylim(min(-0.05, left.get_ylim()[0]), max(1.05, left.get_ylim()[1]))
            left.set_ylabel("normalised score")
            left.set_title(f"{name}: {len(over.ends)} task{'s' * (len(over.ends) > 1)}", fontsize=10)
            most = max(variant.labels for variant, *_ in over.each)
            largest = [(variant, profile) for variant, profile, _ in over.each if variant.labels in (0, most)]
            colours = colours_of([variant for variant, _ in largest])
            for place, (variant, profile) in enumerate(largest):
                _draw_curve(right, profile, variant.name, colours[place], place)
            right.set_xlabel(PROFILE_TEXTS[0], fontsize=9)
            right.set_ylabel(PROFILE_TEXTS[1])
            right.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
        figure.suptitle(one_line(title), x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def save_figure(figure: Figure, stem: Path) -> None:
    """Write `stem.png` and `stem.svg` without dates or versions."""
    with matplotlib.rc_context(STYLE):
        figure.savefig(stem.with_name(stem.name + ".png"), dpi=200, metadata={"Software": None})
        figure.savefig(stem.with_name(stem.name + ".svg"), metadata={"Date": None, "Creator": None})


def colour_of(guidance: str) -> str:
    """Return the colour of a kind of guidance; an unknown kind gets a fixed one of the other colours."""
    kind = registry.guides().get(guidance)
    return kind.colour if kind and kind.colour else OTHER_COLOURS[sum(guidance.encode()) % len(OTHER_COLOURS)]


def colours_of(variants: Sequence[Variant]) -> list[tuple[float, float, float]]:
    """Return each variant's colour: that of its guidance, paler for smaller label budgets."""
    colours = []
    for variant in variants:
        budgets = sorted({other.labels for other in variants if other.guidance == variant.guidance})
        pale = 0.6 * (1 - (budgets.index(variant.labels) + 1) / len(budgets))
        red, green, blue = ((1 - pale) * channel + pale for channel in to_rgb(colour_of(variant.guidance)))
        colours.append((red, green, blue))
    return colours


def axis_name(metric: str) -> str:
    """Return an axis label for a metric."""
    return AXIS_NAMES.get(metric, one_line(metric.replace("_", " ")))
