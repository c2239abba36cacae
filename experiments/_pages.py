"""Parts of the result pages: sections between marks, short tables, CSV files for the viewer, and figures.

A page has lines `<!-- NAME -->` and `<!-- end of NAME -->`; a generator replaces what stands between the two lines.
"""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from cuelearner_jax.report.figures import STYLE, separate_heights
from cuelearner_jax.report.statistics import Interval

DOCS = Path(__file__).resolve().parents[1] / "docs"
INTERVAL = re.compile(r"(\S+) \[([^,\]]+(?:,\d{3})*), ([^\]]+)\]")
GREY = "#767676"


# --- text ------------------------------------------------------------------------------------------------------------


def rendered(page: str, sections: Mapping[str, str]) -> str:
    """Return the page with each section between its marks.

    Raises:
        ValueError: the page has no such marks.
    """
    for name, text in sections.items():
        first, last = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        before, mark, rest = page.partition(first)
        _, end, after = rest.partition(last)
        if not mark or not end:
            raise ValueError(f"the page has no place for {name}: give it the lines {first.strip()} and {last}")
        page = f"{before}{first}\n{text}\n\n{last}{after}"
    return page


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [header, ["---"] * len(header), *rows])


def fold(title: str, text: str) -> str:
    """Return a text behind a fold that shows only its title."""
    lines = (f"    {line}".rstrip() for line in text.split("\n"))
    return "\n".join([f'??? note "{title}"', "", *lines])


def viewer_link(text: str, table: Path, page: Path) -> str:
    """Return a link from a page to a CSV file on the viewer page; both files are in docs/."""
    docs = docs_of(page)
    seen = Path(os.path.relpath(docs / "tables.md", page.resolve().parent)).as_posix()
    return f"[{text}]({seen}?file={Path(os.path.relpath(table.resolve(), docs)).as_posix()})"


def docs_of(page: Path) -> Path:
    """Return the folder docs/ above a page, or the page's own folder where there is none."""
    return next((folder for folder in page.resolve().parents if folder.name == "docs"), page.resolve().parent)


def image(alt: str, stem: Path, page: Path) -> str:
    """Return an image of Markdown: the file `stem.png` as seen from a page."""
    return f"![{alt}]({Path(os.path.relpath(stem, page.parent)).as_posix()}.png)"


# --- tables ----------------------------------------------------------------------------------------------------------


def apart(header: Sequence[str], rows: Sequence[Sequence[str]]) -> tuple[list[str], list[list[str]]]:
    """Return the table with each column of `0.62 [0.54, 0.71]` as three: the estimate, its lower and its upper end."""
    names, columns = [], []
    for at, name in enumerate(header):
        cells = [row[at] for row in rows]
        found = [INTERVAL.fullmatch(cell) for cell in cells]
        if not any(found):
            names.append(name)
            columns.append(cells)
            continue
        names += [name, f"{name}, lower", f"{name}, upper"]
        three = [match.groups() if match else (cell, "", "") for match, cell in zip(found, cells, strict=True)]
        columns += [list(column) for column in zip(*three, strict=True)]
    return names, [list(row) for row in zip(*columns, strict=True)]


def write_csv(file: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write a table whose cells are text; intervals get columns of their own."""
    names, cells = apart(header, rows)
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerows([names, *cells])


def read_csv(file: Path) -> list[dict[str, Any]]:
    """Return the rows of a CSV file; cells that hold a number are numbers, empty ones None."""
    with file.open(newline="", encoding="utf-8") as opened:
        return [{name: cell_value(cell) for name, cell in row.items()} for row in csv.DictReader(opened)]


def cell_value(cell: str) -> Any:
    """Return the number in a cell, None of an empty cell, or the cell's text."""
    if not cell:
        return None
    try:
        return float(cell)
    except ValueError:
        return cell


def interval_of(row: Mapping[str, Any], name: str) -> Interval | None:
    """Return the columns `name`, `name_lower`, `name_upper` of a row, or None where the estimate is missing."""
    if row.get(name) is None:
        return None
    ends = (row[f"{name}_{end}"] for end in ("lower", "upper"))
    return Interval(*(np.array(np.nan if value is None else value) for value in (row[name], *ends)))


def interval_cell(found: Interval | None, digits: int = 2) -> str:
    """Return an interval as a table shows it: `0.62 [0.54, 0.71]`."""
    if found is None:
        return ""
    estimate, lower, upper = (f"{float(value):.{digits}f}" for value in found)
    return estimate if np.isnan(found.lower) else f"{estimate} [{lower}, {upper}]"


# --- figures ---------------------------------------------------------------------------------------------------------


class Bar(NamedTuple):
    """A row of a forest plot."""

    name: str
    found: Interval
    colour: str
    hollow: bool = False  # a control or a reference


def forest(axes: Axes, bars: Sequence[Bar], even: Interval | None = None, form: str = "{:.2f}") -> None:
    """Draw a dot with its interval for each row, the first row on top, each with its value beside it.

    Args:
        axes: where to draw.
        bars: the rows.
        even: an interval to compare all rows with, drawn as a vertical band.
        form: of the values.
    """
    if even is not None:
        if not np.isnan(even.lower):
            axes.axvspan(float(even.lower), float(even.upper), color=GREY, alpha=0.18, linewidth=0)
        axes.axvline(float(even.estimate), color=GREY, linewidth=1.2)
    for place, bar in enumerate(bars):
        ends = [float(bar.found.lower), float(bar.found.upper)]
        if not np.isnan(ends).any():
            axes.plot(ends, [place, place], color=bar.colour, linewidth=2.4, alpha=0.55, solid_capstyle="round")
        face = "white" if bar.hollow else bar.colour
        axes.plot(float(bar.found.estimate), place, "o", color=bar.colour, markerfacecolor=face, markersize=6)
        told = form.format(float(bar.found.estimate))
        axes.text(1.02, place, told, transform=axes.get_yaxis_transform(), va="center", fontsize=9)
    axes.set_yticks(range(len(bars)), [bar.name for bar in bars])
    axes.set_ylim(len(bars) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")


def name_ends(axes: Axes, ends: Sequence[tuple[float, str, str]], size: float = 9) -> None:
    """Write the name of each curve right of the axes, at the height of its end, moved apart where names would meet.

    Args:
        axes: with its final limits; the figure is laid out first.
        ends: the height of each curve's end, its name and its colour.
        size: of the letters, in points.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()
    low, high = axes.get_ylim()
    heights = axes.transData.transform([(1.0, end) for end, _, _ in ends])[:, 1]
    room = axes.bbox.height
    lowest = axes.transData.transform((1.0, low))[1]
    places = (heights - lowest) / room
    gap = 1.35 * size * figure.dpi / 72 / room
    top = max(1.0, gap * (len(ends) - 1))
    for (_, name, colour), place in zip(ends, separate_heights(places, gap, 0.0, top), strict=True):
        dark = tuple(0.75 * channel for channel in to_rgb(colour))
        axes.text(1.02, place, name, transform=axes.transAxes, color=dark, fontsize=size, va="center")
    axes.set_ylim(low, high)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure in the style of all reports; draw inside `matplotlib.rc_context(STYLE)`."""
    with matplotlib.rc_context(STYLE):
        return Figure(figsize=(width, height), layout="constrained")
