"""Write the table and the figures of docs/results/corrections.md from recorded pieces, and nothing else of the page.

    python experiments/corrections_page.py [--data docs/data/corrections_alone] [--page docs/results/corrections.md]

The data are what `corrections_alone.py` leaves in its `--out`. The short table goes between the lines
`<!-- corrections -->` and `<!-- end of corrections -->` of the page. Written beside the data: two figures;
`success.csv`, success of each kind, teacher and budget with its interval over label seeds; and `labels.csv`, success
with 100 labels (`reach`: 250) and the labels that match as many of the reference. The latter are read off nondecreasing
curves, on straight lines over the logarithm of the labels.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from _efficiency_statistics import Bounds, isotonic, labels_for, percentiles
from _pages import GREY, Bar, forest, markdown, new_figure, rendered, viewer_link
from _pages import write_csv as write_text_csv
from corrections_alone import KINDS, SCALES, TUNED_LABELS, whole
from jaxtyping import Float
from matplotlib.figure import Figure

from cuelearner_jax.guides import registry
from cuelearner_jax.report import statistics
from cuelearner_jax.report.figures import STYLE, colour_of, save_figure

REFERENCE = {world: "offset" if "offset" in kinds else "relative" for world, kinds in KINDS.items()}
MATCHED = {world: TUNED_LABELS.get(world, 100) for world in KINDS}  # labels of the reference that others match
TEACHERS = {"plain": "no fault", "wrong": "20% wrong", "one": "one cue a label"}
SHUFFLED = "shuffled"
TICKS = (25, 100, 250, 500)  # labels


class Curve(NamedTuple):
    """Success of one kind under one teacher."""

    budgets: tuple[int, ...]
    success: Float[np.ndarray, "seeds budgets"]

    def at(self, labels: int) -> statistics.Interval | None:
        """Return the interquartile mean over seeds with its interval; None where not measured."""
        if labels not in self.budgets:
            return None
        return statistics.interval(self.success[:, self.budgets.index(labels)])


Curves = Mapping[tuple[str, str, str], Curve]  # by world, kind, teacher


def read(folder: Path) -> dict[tuple[str, str, str], Curve]:
    """Return all curves of the recorded pieces, without conditions that some seeds lack."""
    found = {}
    for world, kinds in KINDS.items():
        for kind in kinds:
            file = folder / world / f"{kind}.json"
            told = json.loads(file.read_text()) if file.exists() else {"scale": "smoke", "rows": []}
            rows = whole(told["rows"], SCALES[told["scale"]].seeds)
            for condition in dict.fromkeys(row["condition"] for row in rows):
                own = [row for row in rows if row["condition"] == condition]
                seeds = sorted({row["seed"] for row in own})
                cells = {(row["seed"], row["labels"]): row["success"] for row in own}
                budgets = tuple(sorted({row["labels"] for row in own}))
                table = [[cells[seed, labels] for labels in budgets] for seed in seeds]
                found[world, kind, condition] = Curve(budgets, np.array(table))
    return found


def ratio(kind: Curve, reference: Curve, matched: int = 100) -> tuple[Bounds, tuple[float, float]] | None:
    """Return the labels of a kind that match so many of the reference, over these, with their 95% interval.

    None where the reference never had so many, or the kind has one budget alone.
    """
    if matched not in reference.budgets or len(kind.budgets) < 2:
        return None
    own = [statistics.interquartile_mean(kind.success)[None], statistics.resampled(kind.success, seed=1)]
    other = [statistics.interquartile_mean(reference.success)[None], statistics.resampled(reference.success, seed=2)]
    wanted = isotonic(np.concatenate(other))[:, reference.budgets.index(matched)]
    found = labels_for(np.array(kind.budgets), isotonic(np.concatenate(own)), wanted)
    shares = Bounds(found.lower / matched, found.upper / matched)
    first = Bounds(shares.lower[0], shares.upper[0])
    return first, percentiles(Bounds(shares.lower[1:], shares.upper[1:]))


def ratio_words(found: tuple[Bounds, tuple[float, float]] | None) -> str:
    """Return a ratio as a cell."""
    if found is None:
        return ""
    (low, high), (lower, upper) = found
    told = f"{low:.2f}" if low == high else (f"above {low:.2f}" if np.isinf(high) else f"below {high:.2f}")
    return f"{told} [{lower:.2f}, {'no bound' if np.isinf(upper) else f'{upper:.2f}'}]"


def percent(found: statistics.Interval | None) -> str:
    """Return success as a cell, in percent."""
    if found is None:
        return ""
    bounds = "" if np.isnan(found.lower) else f" [{100 * found.lower:.0f}, {100 * found.upper:.0f}]"
    return f"{100 * found.estimate:.0f}{bounds}"


def title_of(kind: str) -> str:
    """Return the name of a kind."""
    known = registry.find_or_none(kind)
    return "no labels" if kind == "base" else (known.title or kind if known else kind)


def table(curves: Curves) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of `labels.csv`."""
    header = ["world", "kind", "labels"]
    header += [f"success, {told} [%]" for told in TEACHERS.values()]
    header += [f"most labels, answers {SHUFFLED} [%]"]
    header += [f"times the labels of the reference, {told}" for told in TEACHERS.values()]
    rows = []
    for world, kinds in KINDS.items():
        for kind in kinds:
            own = {teacher: curves.get((world, kind, teacher)) for teacher in (*TEACHERS, SHUFFLED)}
            if not any(own.values()):
                continue
            labels = 0 if kind == "base" else MATCHED[world]
            cells = [percent(curve.at(labels)) if (curve := own[teacher]) else "" for teacher in TEACHERS]
            control = own[SHUFFLED]
            cells.append(percent(control.at(control.budgets[-1])) if control else "")
            for teacher in TEACHERS:
                reference, curve = curves.get((world, REFERENCE[world], teacher)), own[teacher]
                said = kind != REFERENCE[world] and curve is not None and reference is not None
                cells.append(ratio_words(ratio(curve, reference, MATCHED[world])) if said else "")  # pyright: ignore[reportArgumentType]
            rows.append([world, title_of(kind), str(labels), *cells])
    return header, rows


def short_table(curves: Curves) -> str:
    """Return the page's table: success of each kind under a teacher without faults, a column a world."""
    worlds, rows = worlds_of(curves), {}
    for world, kinds in KINDS.items():
        for kind in kinds:
            if (curve := curves.get((world, kind, "plain"))) is not None:
                rows.setdefault(kind, {})[world] = percent(curve.at(0 if kind == "base" else MATCHED[world]))
    cells = [[title_of(kind), *(row.get(world, "") for world in worlds)] for kind, row in rows.items()]
    return markdown(["success [%]", *(f"`{world}`, {MATCHED[world]} labels" for world in worlds)], cells)


def worlds_of(curves: Curves) -> list[str]:
    """Return the worlds of which anything is recorded."""
    return [world for world in KINDS if any(world == key[0] for key in curves)]


def section(curves: Curves, data: Path, page: Path) -> str:
    """Return the page's section: the table and links to the whole tables."""
    links = [viewer_link("faulty teachers, controls, labels that match the reference", data / "labels.csv", page)]
    links.append(viewer_link("every kind, teacher and budget", data / "success.csv", page))
    return f"{short_table(curves)}\n\nTables:\n" + ",\n".join(links) + "."


def draw_budget(curves: Curves, stem: Path) -> None:
    """Draw success under a teacher without faults, a panel a world."""
    worlds = worlds_of(curves)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(3.6 * len(worlds), 3.4)
        for axes, world in zip(figure.subplots(1, len(worlds), squeeze=False)[0], worlds, strict=True):
            bars = []
            for kind in KINDS[world]:
                curve = curves.get((world, kind, "plain"))
                found = curve.at(0 if kind == "base" else MATCHED[world]) if curve else None
                if found is not None:
                    colour = GREY if kind == "base" else colour_of(kind)
                    bars.append(
                        Bar(title_of(kind), statistics.Interval(*(100 * v for v in found)), colour, kind == "base")
                    )
            forest(axes, bars, bars[0].found, "{:.0f}")
            axes.set_xlim(-3, 103)
            axes.set_title(world, fontweight="bold", fontsize=11)
            axes.set_xlabel(f"success with {MATCHED[world]} labels [%]")
        save_figure(figure, stem)


def draw(curves: Curves, stem: Path) -> None:
    """Draw success over labels: a row of panels a teacher, a column a world."""
    worlds = [world for world in KINDS if any(world == key[0] for key in curves)]
    figure = Figure(figsize=(1 + 2.9 * len(worlds), 7.2), layout="constrained")
    panels = figure.subplots(len(TEACHERS), len(worlds), squeeze=False, sharey=True)
    for column, world in enumerate(worlds):
        for row, (teacher, told) in enumerate(TEACHERS.items()):
            axes = panels[row][column]
            base = curves.get((world, "base", "plain"))
            if base is not None:
                axes.axhline(100 * float(base.success.mean()), color=GREY, linestyle=":", label="no labels")
            axes.set_visible(any((world, kind, teacher) in curves for kind in KINDS[world]))
            for kind in KINDS[world]:
                curve = curves.get((world, kind, teacher))
                if kind != "base" and curve is not None and len(curve.budgets) > 1:
                    _draw_curve(axes, kind, curve)
            axes.set(ylim=(0, 100), title=f"{world}, {told}")
            axes.set_xscale("log")
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_xticks(TICKS, [str(labels) for labels in TICKS], minor=False)
            axes.minorticks_off()
        panels[-1][column].set_xlabel("labels")
    for row in panels:
        row[0].set_ylabel("success [%]")
    named = {label: handle for axes in panels.ravel() for handle, label in zip(*axes.get_legend_handles_labels())}  # noqa: B905
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    save_figure(figure, stem)


def _draw_curve(axes: object, kind: str, curve: Curve) -> None:
    found = statistics.interval(curve.success)
    drawn = {"color": colour_of(kind), "linewidth": 1.4, "label": title_of(kind)}
    axes.plot(curve.budgets, 100 * found.estimate, marker="o", markersize=3, **drawn)  # pyright: ignore
    if not np.isnan(found.lower).any():
        bounds = 100 * found.lower, 100 * found.upper
        axes.fill_between(curve.budgets, *bounds, color=drawn["color"], alpha=0.12, linewidth=0)  # pyright: ignore


def write_all(curves: Curves, file: Path) -> None:
    """Write success of everything that was measured."""
    with file.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerow(["world", "kind", "teacher", "labels", "seeds", "success", "lower", "upper"])
        for (world, kind, teacher), curve in curves.items():
            for labels in curve.budgets:
                found = curve.at(labels)
                assert found is not None
                values = ["" if np.isnan(value) else f"{float(value):.4f}" for value in found]
                writer.writerow([world, kind, teacher, labels, len(curve.success), *values])


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page's table, the figures and the CSV files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("docs/data/corrections_alone"))
    parser.add_argument("--page", type=Path, default=Path("docs/results/corrections.md"))
    given = parser.parse_args(arguments)
    curves = read(given.data)
    if not curves:
        parser.error(f"{given.data} holds no pieces: give the --out of corrections_alone.py")
    draw(curves, given.data / "success")
    write_all(curves, given.data / "success.csv")
    draw_budget(curves, given.data / "budget")
    write_text_csv(given.data / "labels.csv", *table(curves))
    sections = {"corrections": section(curves, given.data, given.page)}
    page = rendered(given.page.read_text(encoding="utf-8"), sections)
    given.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
