"""What the page of adaptation shows: which lines and columns of a table, and where whole tables are written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import _adaptation_overview as overview
from _adaptation import UNCHANGED, Study
from _adaptation_tables import Line, Row, lines, rewarded_steps
from _pages import markdown, viewer_link, write_csv

BUDGET = overview.BUDGET  # labels of the lines that short tables show


class Table(NamedTuple):
    """A table whose rows are lines of recorded data; the page shows some of its rows and columns."""

    header: list[str]
    lines: list[Line]
    cells: list[list[str]]

    def short(self, columns: Sequence[str]) -> str:
        """Return the page's table: the rows of `few_of`, the first column and those named."""
        few, at = few_of(self.lines), [0, *(self.header.index(name) for name in columns if name in self.header)]
        rows = [row for line, row in zip(self.lines, self.cells, strict=True) if any(line is one for one in few)]
        return markdown([self.header[place] for place in at], [[row[place] for place in at] for row in rows])


class Output(NamedTuple):
    """Where the page and its tables are written."""

    data: Path
    page: Path

    def link(self, name: str, text: str, header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
        """Write a table as a CSV file; return a link to it on the viewer page."""
        file = self.data / "tables" / f"{name}.csv"
        write_csv(file, header, cells)
        return viewer_link(text, file, self.page)

    def links(self, *links: str) -> str:
        """Return the line of a section that leads to its tables."""
        return "Tables:\n" + ",\n".join(link for link in links if link) + "."


def few_of(known: Sequence[Line]) -> list[Line]:
    """Return, of each method and variant, the line with the most labels up to `BUDGET`; of fine-tuning the last."""
    found: dict[tuple[str, str], Line] = {}
    for line in sorted(known, key=lambda line: line.after):
        key = line.method, line.variant
        if key not in found or line.method == "finetuning" or line.after <= BUDGET:
            found[key] = line
    return list(found.values())


def whole_of(rows: Sequence[Row], least: float) -> Line | None:
    """Return the line of the base agents in the unchanged world."""
    found = lines(rows, UNCHANGED, least=least)
    return found[0] if found else None


def after(line: Line) -> str:
    """Return labels or steps as a cell."""
    if line.method == "finetuning":
        return f"{line.after:,} steps"
    return f"{line.after:,} labels" if line.after else ""


AMOUNTS = ["labels", "rewarded steps"]


def amounts(line: Line, start: Line, study: Study) -> list[str]:
    """Return labels and rewarded steps as cells."""
    labels = f"{line.after:,}" if line.after and line.method != "finetuning" else ""
    steps = rewarded_steps(line, start, study)
    return [labels, "" if steps is None else f"{steps:,}"]


def shown(known: Sequence[Line]) -> list[Line]:
    """Return the lines of whole tables: of fine-tuning the first, a quarter and the last."""
    steps = [line.after for line in known if line.method == "finetuning" and line.after]
    few = {value for value in steps if value in (min(steps), max(steps)) or value * 4 == max(steps)} if steps else set()
    return [line for line in known if line.method != "finetuning" or line.after in few]


def shares_used(line: Line) -> str:
    """Return the share of models that were used as a cell; empty where nothing was decided."""
    return f"{100 * line.columns['used'].mean():.0f}%" if "used" in line.columns else ""
