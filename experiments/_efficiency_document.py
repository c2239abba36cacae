"""A report's section on label efficiency in Markdown, and its two figures."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from _efficiency import Carried, Efficiency, Known
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cuelearner_jax.report import escaping
from cuelearner_jax.report.escaping import one_line
from cuelearner_jax.report.figures import STYLE, axis_name, colour_of, draw_budgets
from cuelearner_jax.report.statistics import Interval
from cuelearner_jax.report.tables import markdown_table
from cuelearner_jax.report.variants import Variant, shortened

LARGEST_RATIO = 3.0  # shown of steps to the level over the unguided agents': what lies above is drawn at the edge
Shown = Sequence[tuple[Variant, Interval]]


# --- the section -----------------------------------------------------------------------------------------------------


def efficiency_lines(found: Efficiency) -> list[str]:
    """Lines of Markdown: the figures, a row for each variant, and what budgets buy."""
    by_run = any(each.variant.run for each in found.carried)
    figures = {"labels_to_quality": of_guides(found), "steps_saved": of_ratios(found)}
    lines = ["", "## Label efficiency", ""]
    lines += [f"![{name.replace('_', ' ')}]({name}.png)\n" for name, shown in figures.items() if shown]
    lines += [f"The level is {found.level:.3f}: {escaping.markdown(found.origin)}.", ""]
    header = ["guidance", "labels", "guide alone", "steps to the level", "of draws reach it", "ratio to unguided"]
    header += [f"mean over the curve to {found.shared:,}", "more than unguided", "ratio to unguided"]
    lines += markdown_table(["run"] * by_run + header, [_cells(each, by_run) for each in found.carried])
    if found.labels_to_level:
        share = f"{found.question.within:.2f}"
        lines += ["", f"Labels with which the level is reached within {share} of the unguided agents' steps:", ""]
        header = ["run"] * by_run + ["guidance", "budgets", "labels", "of draws reach it"]
        lines += markdown_table(
            header,
            [
                [escaping.markdown(each.run)] * by_run
                + [escaping.markdown(each.guidance), ", ".join(f"{budget:,}" for budget in each.budgets)]
                + [format_known(each.labels, "{:,.0f}"), f"{each.reached:.0%}"]
                for each in found.labels_to_level
            ],
        )
    if found.equal_area:
        lines += ["", "Labels for an equal area under the curve:", ""]
        header = ["run"] * by_run + ["guidance", "labels", "mean over the curve", "as many of", "labels", "ratio"]
        lines += markdown_table(
            header,
            [
                [escaping.markdown(each.run)] * by_run
                + [escaping.markdown(each.reference), f"{each.reference_labels:,}", f"{each.area:.3f}"]
                + [
                    escaping.markdown(each.guidance),
                    format_known(each.labels, "{:,.0f}"),
                    format_known(each.ratio, "{:.2f}"),
                ]
                for each in found.equal_area
            ],
        )
    return [*lines, "", NOTE]


NOTE = (
    "The level is held fixed. Steps to it are those of the interquartile mean, on straight lines between evaluations. "
    "Intervals are 95% percentile bootstraps: the seeds of each variant are drawn with replacement, 2,000 times, "
    "independently of those of others. A curve that ends below the level has needed more than its last step, and "
    "nothing else is said of it: such draws count as infinite at the upper end of an interval and as their last step "
    "at the lower one (of a ratio, the other way round where they are unguided ones). Areas of a kind are made "
    "nondecreasing in its labels (isotonic regression) and lie on straight lines over the logarithm of the labels; "
    "beyond its budgets nothing is assumed. The smallest of several budgets is chosen by its luck as well, so it errs "
    "to the low side."
)


def format_known(known: Known, form: str) -> str:
    """A quantity with its interval in words: `0.62 [0.54, 0.71]`, `above 1.40 [1.30, no bound]`."""
    low, high = (float(bound) for bound in known.bounds)
    if low == high:
        text = form.format(low)
    elif np.isinf(high):
        text = f"above {form.format(low)}" if low > 0 else "not known"
    else:
        text = f"below {form.format(high)}" if low <= 0 else f"{form.format(low)} to {form.format(high)}"
    if np.isnan(known.lower):
        return text
    upper = form.format(known.upper) if np.isfinite(known.upper) else "no bound"
    return f"{text} [{form.format(known.lower)}, {upper}]"


def _cells(each: Carried, by_run: bool) -> list[str]:
    variant = each.variant
    cells = [escaping.markdown(variant.run)] if by_run else []
    cells += [escaping.markdown(variant.guidance), f"{variant.labels:,}", _interval(each.guide)]
    cells += [format_known(each.steps, "{:,.0f}"), f"{each.reached:.0%}", _known(each.ratio, "{:.2f}")]
    cells += [_interval(variant.mean), _interval(each.area_difference, "{:+.3f}")]
    return [*cells, _interval(each.area_ratio, "{:.2f}")]


def _known(known: Known | None, form: str) -> str:
    return format_known(known, form) if known else ""


def _interval(found: Interval | None, form: str = "{:.3f}") -> str:
    if found is None or np.isnan(found.estimate):
        return ""
    estimate, lower, upper = (form.format(float(value)) for value in found)
    return estimate if np.isnan(found.lower) else f"{estimate} [{lower}, {upper}]"


# --- the figures -----------------------------------------------------------------------------------------------------


def of_guides(found: Efficiency) -> Shown:
    """Describe the guides' own performance; empty unless it varies with labels."""
    shown = [(each.variant, each.guide) for each in found.carried if each.guide is not None]
    return shown if any(variant.labels for variant, _ in shown) else []


def of_ratios(found: Efficiency) -> Shown:
    """Steps to the level over the unguided agents'; infinite where only a lower bound is known."""
    shown = []
    for each in found.carried:
        if each.ratio is None or (np.isinf(each.ratio.bounds.upper) and each.ratio.bounds.lower <= 0):
            continue
        high = float(each.ratio.bounds.upper)
        estimate = np.inf if np.isinf(high) else high  # below `high`, where the unguided agents never get there
        ends = np.array(each.ratio.lower), np.array(each.ratio.upper)
        shown.append((each.variant, Interval(np.array(estimate), *ends)))
    return shown if any(variant.labels for variant, _ in shown) else []


def efficiency_figures(found: Efficiency, title: str, metric: str) -> dict[str, Figure]:
    """The figures that there is something to show in, by the names of their files."""
    figures = {}
    if guides := of_guides(found):
        figures["labels_to_quality"] = _panels(guides, f"{title}: the guide alone", axis_name(metric))
    if ratios := of_ratios(found):
        level = f"steps to {found.level:.3g} over unguided"
        figures["steps_saved"] = _panels(ratios, title, level, even=1.0)
    return figures


def _panels(shown: Shown, title: str, name: str, even: float | None = None) -> Figure:
    """A panel for each run against labels; `even`: a height at which guidance makes no difference, of ratios."""
    edge = np.inf
    if even is not None:
        heights = np.array([[found.estimate, found.upper] for _, found in shown])
        edge = min(LARGEST_RATIO, float(1.2 * heights.max(where=np.isfinite(heights), initial=1.6 * even)))
        if heights.max() <= edge:
            edge = np.inf
        shown = [(variant, Interval(*(np.minimum(value, edge) for value in found))) for variant, found in shown]
    runs = list(dict.fromkeys(variant.run for variant, _ in shown))
    columns = min(3, len(runs))
    lines = -(-len(runs) // columns)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(max(6.0, 3.6 * columns), 1.2 + 3.2 * lines), layout="constrained")
        panels = figure.subplots(lines, columns, sharey=True, squeeze=False)
        for axes, run in zip(panels.flat, runs, strict=False):
            own = [(variant, found) for variant, found in shown if variant.run == run]
            draw_budgets(axes, [variant for variant, _ in own], [found for _, found in own], shortened(run))
            if even is not None:
                _limit(axes, even, edge)
        for axes in panels.flat[len(runs) :]:
            axes.set_axis_off()
        for axes in panels[:, 0]:
            axes.set_ylabel(name)
        legend = {}
        for axes in panels.flat[: len(runs)]:
            handles, names = axes.get_legend_handles_labels()
            legend |= dict(zip(names, handles, strict=True))
        figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=min(4, len(legend)))
        figure.suptitle(one_line(title), x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _limit(axes: Axes, even: float, edge: float) -> None:
    """Draw the limits of ratios: a line where nothing is saved, and words at the edge for levels never reached."""
    axes.axhline(even, color=colour_of("none"), linewidth=1)
    axes.set_ylim(bottom=0)
    if np.isfinite(edge):
        axes.axhline(edge, color="#595959", linewidth=0.8, linestyle=":")
        across = axes.get_yaxis_transform()
        axes.text(0.99, edge, "or more, or never", transform=across, ha="right", va="bottom", fontsize=8)
        axes.set_ylim(0, 1.08 * edge)
