"""Write the figures and tables of docs/results/bootstrapping.md from recorded runs, and nothing else of the page.

    python experiments/bootstrapping_page.py [--data docs/data/bootstrapping] [--page docs/results/bootstrapping.md]
    python experiments/bootstrapping_page.py --keep-reports       # seconds: from the reports that are there

For every world with runs in the data (WORLD/RUN/PIECE, as the two experiments of that name leave them)
`label_efficiency.py` writes WORLD/report. Its `efficiency.csv` gives the figure and the short table between the lines
`<!-- WORLD -->` and `<!-- end of WORLD -->` of the page; the viewer page shows the CSV files whole. Runs at the scale
`cpu` (cpu/WORLD/RUN/PIECE) have sections of their own, `<!-- WORLD-cpu -->`.
"""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import billiards_bootstrapping
import matplotlib
import navigation_bootstrapping
import numpy as np
from _pages import (
    GREY,
    Bar,
    fold,
    forest,
    image,
    interval_cell,
    interval_of,
    markdown,
    name_ends,
    new_figure,
    read_csv,
    rendered,
    viewer_link,
)
from _pieces import LABEL_EFFICIENCY, Experiment, folder_at, report_command, reported

from cuelearner_jax.report.figures import STYLE, colour_of, names_of, save_figure
from cuelearner_jax.report.variants import guidance_name

EXPERIMENTS = (billiards_bootstrapping.EXPERIMENT, navigation_bootstrapping.EXPERIMENT)
MISSING = "## Missing\n"
LABELS = 500  # the budget that short tables and figures show; else the nearest one
RUNS = {
    "frame": "",
    "raw": "raw coordinates",
    "paced": "paced",
    "paced-any-lead": "paced, no lead",
    "paced-random": "random answers, paced",
    "longer": "nearest likely aim",
    "flipped-05": "5% wrong",
    "flipped-10": "10% wrong",
    "flipped-20": "20% wrong",
    "random": "random answers",
    "shuffled": "shuffled answers",
    "paced-shuffled": "shuffled answers, paced",
    "silent-20": "20% unanswered",
    "indifferent": "indifferent within 20 degrees",
    "biased": "biased by 10 degrees",
    "instalments": "in three instalments",
    "ensemble": "five models",
    "active": "five models, chosen questions",
    "page": "labelling page, 10% wrong",
}
PERFECT = "perfect"  # kinds whose names begin so take the shipped teacher's shots
PERFECT_COLOUR = "#882255"
CONTROLS = ("random", "paced-random", "shuffled", "paced-shuffled")
TABLES = {
    "efficiency": "all budgets",
    "labels_to_level": "labels to the level",
    "equal_area": "labels for an equal mean",
}
FOLDED = ("clutter-cpu",)  # worlds whose figure says enough: the table stands behind a fold
OVERVIEW = {"clutter": "Navigation", "regulation": "Billiards, regulation table"}
Row = Mapping[str, Any]


class Place(NamedTuple):
    """One world at one scale: the source of one section of the page."""

    experiment: Experiment
    world: str
    scale: str

    @property
    def mark(self) -> str:
        """The name between the marks of the page."""
        return self.world if self.scale == "paper" else f"{self.world}-{self.scale}"

    @property
    def metric(self) -> str:
        """The measured quantity, in words."""
        return "reward a shot" if self.experiment is EXPERIMENTS[0] else "success"

    def command(self, data: Path) -> list[str] | None:
        """Return the command of the report, or None where no runs or no unguided runs are recorded."""
        command = report_command(self.experiment, self.world, folder_at(data, self.scale), self.scale)
        return command if command and command[0] == LABEL_EFFICIENCY else None

    def report(self, data: Path) -> Path:
        """Return the folder of the report."""
        return folder_at(data, self.scale) / self.world / "report"


def places() -> Iterator[Place]:
    """Return every world at every scale that is reported, in the order of the experiments."""
    for experiment in EXPERIMENTS:
        for scale in (name for name, scale in experiment.scales.items() if scale.reported):
            for world in dict.fromkeys(piece.world for piece in experiment.pieces):
                yield Place(experiment, world, scale)


# --- rows ------------------------------------------------------------------------------------------------------------


def named(row: Row, labels: bool = False) -> str:
    """Return a variant as tables and figures name it: guidance, the run where it is not `frame`, and the labels."""
    kind, run = str(row["guidance"]), RUNS.get(str(row["run"]), str(row["run"]))
    name = "teacher's own shots" if kind.startswith(PERFECT) else guidance_name(kind)
    amount = f"{row['labels']:,.0f} labels" if labels and row["labels"] else ""
    return ", ".join(part for part in (name, amount, run) if part)


def chosen(rows: Sequence[Row]) -> list[Row]:
    """Return one row for each run and guidance: the one whose number of labels is nearest to `LABELS`."""
    found: dict[tuple, Row] = {}
    for row in rows:
        key = row["run"], row["guidance"]
        if key not in found or abs(row["labels"] - LABELS) < abs(found[key]["labels"] - LABELS):
            found[key] = row
    return sorted(found.values(), key=lambda row: (row["guidance"] != "none", -row["mean"]))


def shared_step(report: Path) -> int:
    """Return the step to which means over the curve are taken: the last one that all variants reached."""
    last: dict[tuple, float] = {}
    for row in read_csv(report / "curves.csv"):
        key = row["run"], row["guidance"], row["labels"]
        last[key] = max(last.get(key, 0), row["step"])
    return int(min(last.values()))


def steps_cell(row: Row) -> str:
    """Return the steps to the level with their interval, or what is known of them."""
    ends = [f"{end:,.0f}" if np.isfinite(end) else "no bound" for end in bounds_of(row)]
    estimate = row["steps_to_level"]
    told = f"{estimate:,.0f}" if estimate is not None else f"above {row['steps_to_level_above']:,.0f}"
    return f"{told} [{ends[0]}, {ends[1]}]"


def bounds_of(row: Row) -> tuple[float, float]:
    """Return the ends of the interval of the steps to the level."""
    return row["steps_to_level_lower"], row["steps_to_level_upper"]


def short_table(rows: Sequence[Row], place: Place, level: float, shared: int) -> str:
    """Return the page's table of one world, the best variant first."""
    navigation = place.metric == "success"
    header = ["guidance", "labels", "guide alone", f"{place.metric}, mean over {shared:,} steps"]
    header.append(f"steps to {level:.0%}" if navigation else "of no guidance")
    cells = []
    for row in chosen(rows):
        guide = "" if row["guide"] is None else f"{row['guide']:.2f}"
        last = steps_cell(row) if navigation else interval_cell(interval_of(row, "mean_ratio"))
        digits = 2 if navigation else 3
        labels = f"{row['labels']:,.0f}" if row["labels"] else ""
        cells.append([named(row), labels, guide, interval_cell(interval_of(row, "mean"), digits), last])
    return markdown(header, cells)


# --- figures ---------------------------------------------------------------------------------------------------------


def colour(kind: str) -> str:
    """Return the colour of a guidance; the teacher's own shots have their own."""
    return PERFECT_COLOUR if kind.startswith(PERFECT) else colour_of(kind)


def draw_world(rows: Sequence[Row], place: Place, shared: int, stem: Path) -> None:
    """Draw the mean over the curve of every run and guidance, beside the band of no guidance."""
    own = chosen(rows)
    even = next((interval_of(row, "mean") for row in own if row["guidance"] == "none"), None)
    bars = []
    for row in own:
        kind = str(row["guidance"])
        hollow = kind == "none" or row["run"] in CONTROLS
        found = interval_of(row, "mean")
        assert found is not None
        bars.append(Bar(named(row, labels=True), found, colour(kind), hollow))
    with matplotlib.rc_context(STYLE):
        figure = new_figure(8, 0.9 + 0.3 * len(bars))
        axes = figure.subplots()
        forest(axes, bars, even, "{:.2f}" if place.metric == "success" else "{:.3f}")
        axes.set_xlim(left=0)
        axes.set_xlabel(f"{place.metric}, mean over {shared:,} steps (grey: no guidance)")
        save_figure(figure, stem)


def draw_overview(data: Path, stem: Path) -> bool:
    """Draw the mean over the curve against labels, a line for each guidance; return whether there are reports of both.

    Labels of every kind answer the same questions, so that a line to the upper left needs fewer of them.
    """
    known = {place.mark: place for place in places()}
    shown = {mark: known[mark].report(data) for mark in OVERVIEW}
    if not all((report / "efficiency.csv").exists() for report in shown.values()):
        return False
    with matplotlib.rc_context(STYLE):
        figure = new_figure(10, 4)
        panels = figure.subplots(1, len(shown))
        for axes, (mark, report) in zip(panels, shown.items(), strict=True):
            rows = [row for row in read_csv(report / "efficiency.csv") if row["run"] == "frame"]
            shared = shared_step(report)
            axes.set_title(OVERVIEW[mark], fontweight="bold", fontsize=11)
            axes.set_ylabel(f"{known[mark].metric}, mean over {shared:,} steps")
            ends = [_line(axes, kind, rows) for kind in dict.fromkeys(str(row["guidance"]) for row in rows)]
            budgets = sorted({int(row["labels"]) for row in rows if row["labels"]})
            axes.set_xscale("log")
            axes.set_xticks(budgets, names_of(budgets))
            axes.minorticks_off()
            axes.set_xlabel("labels")
            axes.set_ylim(bottom=0)
            name_ends(axes, ends)
        save_figure(figure, stem)
    return True


def _line(axes: Any, kind: str, rows: Sequence[Row]) -> tuple[float, str, str]:
    """Draw a guidance; return where its line ends, its name and its colour."""
    own = sorted((row for row in rows if row["guidance"] == kind), key=lambda row: row["labels"])
    hue = GREY if kind == "none" else colour(kind)
    if own[0]["labels"] == 0:
        axes.axhline(own[0]["mean"], color=hue, linewidth=1.6, linestyle="--")
        if kind == "none":
            axes.axhspan(own[0]["mean_lower"], own[0]["mean_upper"], color=hue, alpha=0.15, linewidth=0)
        return own[0]["mean"], named(own[0]), hue
    labels = [row["labels"] for row in own]
    axes.fill_between(
        labels, [row["mean_lower"] for row in own], [row["mean_upper"] for row in own], color=hue, alpha=0.1, lw=0
    )
    axes.plot(labels, [row["mean"] for row in own], color=hue, marker="o", markersize=4)
    return own[-1]["mean"], named(own[-1]), hue


# --- the page --------------------------------------------------------------------------------------------------------


def section(place: Place, data: Path, page: Path) -> str:
    """Return a world's section from its report: a figure, a short table, links to the tables and what is missing."""
    report = place.report(data)
    rows = read_csv(report / "efficiency.csv")
    level = read_csv(report / "labels_to_level.csv")[0]["level"]
    parts = [image(f"{place.metric} by guidance, {place.world}", report / "carried", page)]
    table = short_table(rows, place, level, shared_step(report))
    parts.append(fold("The numbers of the figure", table) if place.mark in FOLDED else table)
    files = {report / f"{name}.csv": text for name, text in TABLES.items()}
    links = [viewer_link(text, file, page) for file, text in files.items() if file.exists()]
    parts.append(f"The level is {level:.3g}. Tables:\n" + ",\n".join(links) + ".")
    missing = missing_lines((report / "report.md").read_text(encoding="utf-8"))
    if missing:
        parts.append(fold("Runs that are not complete", "\n".join(missing)))
    return "\n\n".join(parts)


def findings(data: Path) -> str:
    """Return the table that begins the page: comparisons of single variants."""
    known = {place.mark: read_csv(place.report(data) / "efficiency.csv") for place in places()}

    def at(mark: str, run: str, kind: str, labels: int) -> Row:
        key = (run, kind, labels)
        return next(row for row in known[mark] if (row["run"], row["guidance"], row["labels"]) == key)

    straight, hundred = at("clutter", "frame", "heuristic", 0), at("clutter", "frame", "relative", 100)
    alone = f"more than {at('clutter', 'frame', 'none', 0)['steps_to_level_above']:,.0f}"
    wrong, right = (at("clutter-cpu", run, "relative", 500)["mean"] for run in ("flipped-20", "frame"))
    nothing = at("clutter-cpu", "frame", "none", 0)["mean"]
    billiards = {
        "500 labels as `intent`, paced": at("regulation", "paced", "intent", 500),
        "500 relative labels": at("regulation", "frame", "relative", 500),
        "100,000 relative labels": at("regulation", "frame", "relative", 100_000),
    }
    rows = [
        ["Navigation, 100 relative labels", "steps to 90% success", f"{hundred['steps_to_level']:,.0f}", alone],
        ["Navigation, walking straight, no labels", "the same", f"{straight['steps_to_level']:,.0f}", alone],
        ["Navigation, two cores, 500 labels", "mean success", f"{right:.2f}", f"{nothing:.2f}"],
        ["The same, 20% of the answers wrong", "mean success", f"{wrong:.2f}", f"{nothing:.2f}"],
    ]
    rows += [
        [f"Billiards, {name}", "mean reward", f"{row['mean_ratio']:.2f} times", "1"] for name, row in billiards.items()
    ]
    long = at("full", "raw", "relative", 1_000)["steps_ratio"]
    rows.append(["Billiards to 10 million steps, 1,000 labels", "steps to the last level", f"{long:.2f} times", "1"])
    return markdown(["guidance", "measured", "with guidance", "without"], rows)


def missing_lines(report: str) -> list[str]:
    """Return the lines of a report about runs that are missing or not complete; none where all are complete."""
    lines = report.partition(MISSING)[2].partition("\n## ")[0].split("\n")
    kept = [line for line in lines if line.startswith("- ") and not line.startswith("- nothing")]
    wrapped = (textwrap.wrap(line, 112, subsequent_indent="  ", break_on_hyphens=False) for line in kept)
    return [line for lines in wrapped for line in lines]


def main() -> int:
    """Report on every world and write the page; return the status of the first command that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("docs/data/bootstrapping"))
    parser.add_argument("--page", type=Path, default=Path("docs/results/bootstrapping.md"))
    parser.add_argument("--keep-reports", action="store_true", help="use the reports that are there")
    asked = parser.parse_args()
    sections = {}
    for place in places():
        command = place.command(asked.data)
        if command is None:
            print(f"{place.mark}: no runs in {asked.data}, or no unguided ones")
            continue
        if not asked.keep_reports and (status := reported(command)):
            return status
        report = place.report(asked.data)
        draw_world(read_csv(report / "efficiency.csv"), place, shared_step(report), report / "carried")
        sections[place.mark] = section(place, asked.data, asked.page)
    if draw_overview(asked.data, asked.data / "overview"):
        sections["findings"] = findings(asked.data)
    asked.page.write_text(rendered(asked.page.read_text(encoding="utf-8"), sections), encoding="utf-8")
    print(f"wrote {asked.page}: {', '.join(sections) or 'nothing new'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
