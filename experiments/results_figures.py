"""Draw the figures of docs/results from docs/data/results: a CSV file each, one row a point with its 95% interval.

    python experiments/results_figures.py [NAME ...]

Columns are panel, series, x, value, lower, upper. Where x is a number a series is a curve, otherwise a mark in the row
of that name. Files are recorded: those of other runs are made by hand from the tables that the runners print.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from cuelearner_jax.guides import registry
from cuelearner_jax.report.figures import OTHER_COLOURS, STYLE, colour_of

DOCS = Path(__file__).resolve().parents[1] / "docs"
TITLES = {  # of the measured quantity
    "adaptation": "percent",
    "arms": "success",
    "bootstrapping": "mean over the curve",
    "corrections": "success [%]",
    "navigation": "success",
    "scripted_arms": "success",
    "zoo": "success",
}
X = {"bootstrapping": "labels", **dict.fromkeys(("arms", "navigation"), "environment steps of a seed")}
GREY = "#7f7f7f"
Row = dict[str, Any]


def read(file: Path) -> list[Row]:
    """Return the rows of a figure, numbers as numbers."""
    with file.open(newline="", encoding="utf-8") as lines:
        return [{name: _number(cell) for name, cell in row.items()} for row in csv.DictReader(lines)]


def write(name: str, samples: Iterable[tuple[str, str, str, Sequence[float]]]) -> None:
    """Write the file of a figure: the mean of each (panel, series, x, sample) with its 95% bootstrap interval."""
    random = np.random.default_rng(0)
    with (DOCS / "data" / "results" / f"{name}.csv").open("w", newline="", encoding="utf-8") as lines:
        out = csv.writer(lines)
        out.writerow(("panel", "series", "x", "value", "lower", "upper"))
        for panel, series, x, sample in samples:
            values = np.array(sample)
            drawn = values[random.integers(len(values), size=(2000, len(values)))].mean(1)
            out.writerow((panel, series, x, *np.round((values.mean(), *np.quantile(drawn, (0.025, 0.975))), 4)))


def _number(cell: str) -> Any:
    try:
        return float(cell)
    except ValueError:
        return cell


def colours(rows: Sequence[Row]) -> dict[str, str]:
    """Return the colour of each series: a kind's own, grey for those without labels."""
    names, spare = dict.fromkeys(str(row["series"]) for row in rows), list(OTHER_COLOURS)
    hues = {}
    for name in names:
        plain = name.startswith(("no ", "not ", "without", "SAC alone"))
        is_kind = registry.guides().get(name) is not None
        hues[name] = GREY if plain else colour_of(name) if is_kind else spare.pop(0)
    return hues


def draw_curves(axes: Axes, rows: Sequence[Row], hues: dict[str, str]) -> None:
    """Draw a curve with its band for each series; a series of one point is a level."""
    for name in dict.fromkeys(row["series"] for row in rows):
        own = [row for row in rows if row["series"] == name]
        x, low, value, high = ([row[column] for row in own] for column in ("x", "lower", "value", "upper"))
        if len(own) == 1:
            axes.axhline(value[0], color=hues[name], linestyle="--", label=name)
            continue
        axes.plot(x, value, color=hues[name], label=name)
        axes.fill_between(x, low, high, color=hues[name], alpha=0.12, linewidth=0)
    axes.set_ylim(bottom=0)
    if min(line.get_xdata().min() for line in axes.lines if line.get_linestyle() == "-") > 0:  # pyright: ignore
        axes.set_xscale("log")
        axes.minorticks_off()
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def draw_marks(axes: Axes, rows: Sequence[Row], hues: dict[str, str]) -> None:
    """Draw a mark with its interval for each row, the first name on top."""
    names, series = list(dict.fromkeys(row["x"] for row in rows)), list(hues)
    for row in rows:
        place = names.index(row["x"]) + 0.7 * ((series.index(row["series"]) + 0.5) / len(series) - 0.5)
        hue = hues[row["series"]]
        label = row["series"] if row["x"] == next(each["x"] for each in rows if each["series"] == row["series"]) else ""
        axes.plot([row["lower"], row["upper"]], [place, place], color=hue, linewidth=2.4, alpha=0.35)
        axes.plot(row["value"], place, "o", color=hue, markersize=6, label=label)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")


def draw(name: str) -> Figure:
    """Return the figure of a name."""
    rows = read(DOCS / "data" / "results" / f"{name}.csv")
    panels, hues = list(dict.fromkeys(row["panel"] for row in rows)), colours(rows)
    curves = all(isinstance(row["x"], float) for row in rows)
    count = len({row["x"] for row in rows})
    with matplotlib.rc_context(STYLE):
        size = (max(7.5, 3.4 * len(panels)), 3.6 if curves else 1.2 + count * (0.2 + 0.07 * len(hues)))
        figure = Figure(figsize=size, layout="constrained")
        for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            own = [row for row in rows if row["panel"] == panel]
            (draw_curves if curves else draw_marks)(axes, own, hues)
            axes.set_title(panel, fontweight="bold", fontsize=11)
            axes.set_xlabel(X.get(name, TITLES[name]))
        if curves:
            figure.axes[0].set_ylabel(TITLES[name])
        keys = {label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels())}  # noqa: B905
        if len(keys) > 1:
            figure.legend(keys.values(), keys.keys(), loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def main() -> None:
    """Draw figures into docs/figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"figures (default: all): {', '.join(TITLES)}")
    for name in parser.parse_args().names or TITLES:
        with matplotlib.rc_context(STYLE):
            draw(name).savefig(DOCS / "figures" / f"results_{name}.png", dpi=130, metadata={"Software": None})


if __name__ == "__main__":
    main()
