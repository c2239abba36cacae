"""Draw figures of recorded results: learning curves and label efficiency. Equal variants give equal bytes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import ticker
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from cuelearner_jax.errors import one_line
from cuelearner_jax.guides import registry
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


def draw_curves(variants: Sequence[Variant], title: str, metric: str) -> Figure:
    """Draw learning curves: interquartile means with interval bands, named in the order of their ends."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(8, 4.5), layout="constrained")
        axes = figure.add_subplot()
        pairs = zip(variants, colours_of(variants), strict=True)
        for variant, colour in sorted(pairs, key=lambda pair: -pair[0].curve.estimate[-1]):
            steps, estimate, lower, upper = variant.curve
            axes.fill_between(steps, lower, upper, color=colour, alpha=0.18 if len(variants) < 6 else 0.12, linewidth=0)
            marker = "o" if len(steps) == 1 else ""
            axes.plot(steps, estimate, color=colour, linewidth=1.8, marker=marker, label=variant.name)
            at = np.minimum(variant.failed, steps[-1])
            axes.plot(at, np.interp(at, steps, estimate), "x", color=colour, markersize=8, clip_on=False)
        if any(len(variant.failed) for variant in variants):
            axes.plot([], [], "x", color="#595959", label="a failed seed, left out")
        axes.set_xlim(0, max(1, *(int(variant.curve.steps[-1]) for variant in variants)))
        axes.set_xlabel("environment steps of a seed")
        axes.set_ylabel(axis_name(metric))
        axes.xaxis.set_major_formatter(ticker.EngFormatter(sep=""))
        axes.set_title(one_line(title), fontweight="bold", fontsize=11, pad=20)
        note = "interquartile mean over seeds, band: its 95% bootstrap interval over seeds"
        note += " and episodes" if all(variant.episodes for variant in variants) else ""
        axes.text(0, 1.025, note, transform=axes.transAxes, color="#595959", fontsize=9)
        figure.legend(loc="outside right upper", fontsize=9 if len(variants) < 20 else 6)
    return figure


def draw_label_efficiency(variants: Sequence[Variant], title: str, metric: str) -> Figure:
    """Draw means over the curve against the label budget; a kind without labels is a horizontal band."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7, 4.2), layout="constrained")
        axes = figure.add_subplot()
        for place, kind in enumerate(dict.fromkeys(variant.guidance for variant in variants)):
            look: dict[str, Any] = {"color": colour_of(kind), "label": guidance_name(kind)}
            points = np.array([(one.labels, *one.mean) for one in variants if one.guidance == kind], float)
            for _, estimate, lower, upper in points[points[:, 0] == 0]:
                axes.axhspan(lower, upper, color=look["color"], alpha=0.12, linewidth=0)
                axes.axhline(estimate, linewidth=1.5, linestyle="--", **look)
            if len(points := points[points[:, 0] > 0]):
                labels, estimate, lower, upper = points.T
                bars = np.nan_to_num([estimate - lower, upper - estimate])
                # All points stand on their budget's tick; caps of different widths tell intervals at one budget apart.
                axes.errorbar(labels, estimate, bars, marker="o", capsize=3 + 2 * place, **look)
        budgets = sorted({variant.labels for variant in variants if variant.labels})
        axes.set_xscale("log")
        axes.set_xticks(budgets, [f"{budget:,}" for budget in budgets], rotation=45)
        axes.minorticks_off()
        axes.set_xlabel("labels")
        axes.set_ylabel(f"{axis_name(metric)}, mean over the curve")
        figure.legend(loc="outside lower center", ncols=5)
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
        budgets = [other.labels for other in variants if other.guidance == variant.guidance]
        pale = 0.6 * (1 - (budgets.index(variant.labels) + 1) / len(budgets))
        red, green, blue = ((1 - pale) * channel + pale for channel in to_rgb(colour_of(variant.guidance)))
        colours.append((red, green, blue))
    return colours


def axis_name(metric: str) -> str:
    """Return an axis label for a metric."""
    return AXIS_NAMES.get(metric, one_line(metric.replace("_", " ")))
