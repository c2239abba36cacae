"""Sections about billiards of the page of adaptation: the recorded study, and agents trained anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import adaptation_billiards
import numpy as np
from _adaptation import UNCHANGED
from _adaptation_cells import AMOUNTS, Output, Table, after, amounts, few_of, shares_used, shown, whole_of
from _adaptation_curves import GAIN_HEADER, curve_points, figure, gain_cells
from _adaptation_tables import NAMES, Line, Row, lines, percent, read, share, spread, tuned
from _pages import fold, image, markdown
from adaptation_billiards import BOUNDS_DEG, LEAST, PLAYED


def billiards(rows: Sequence[Row], folder: Path, out: Output) -> str:
    """Return the section of the three tables: shares of the original, with the gains and everything else as CSV."""
    whole = whole_of(rows, LEAST)
    if whole is None:
        return ""
    tables, curves, gains = world_tables(rows, whole, LEAST), {}, []
    for world in tables:
        if world != UNCHANGED:
            curves[world] = curve_points(lines(rows, world, least=LEAST), "reward", whole)
            gains += [[world, *cells] for cells in gain_cells(curves[world])]
    parts = []
    if any(curves.values()):
        figure(curves, folder / "shares", "share of the original reward", (1.0, "original"))
        parts.append(image("reward as a share of the original", folder / "shares", out.page))
    worlds = [world for world in tables if world != UNCHANGED]
    parts.append(side_by_side({world: tables[world] for world in worlds}, "of the original [%]"))
    header, cells = joined(tables)
    links = [out.link("billiards", "all rows, rewards and held-out agents", header, cells)]
    links += [out.link("billiards_gains", "labels or steps to a gain", ["world", *GAIN_HEADER], gains)] if gains else []
    original = f"{len(whole.bases)} base agents earn {spread(whole.columns['reward'])} a shot in the unchanged world."
    parts.append(f"{original} {out.links(*links)}")
    return "\n\n".join(parts)


def world_tables(rows: Sequence[Row], whole: Line, least: float) -> dict[str, Table]:
    """Return the tables of the worlds that were measured; in the unchanged one the other methods are a control."""
    known = {world: lines(rows, world, least=least) for world in (*BOUNDS_DEG, UNCHANGED)}
    return {
        world: world_table(rows, own, whole, world)
        for world, own in known.items()
        if len(own) >= (2 if world == UNCHANGED else 1)
    }


def with_label_seeds(data: Path, out: Output) -> str:
    """Return the section of billiards agents trained anew, four label seeds each: eight, and eight further ones."""
    parts = []
    for name, folder, told in (("billiards_anew", ".", "The agents"), ("billiards_further", "further", "Eight others")):
        rows = read(data / "anew" / folder / "billiards")
        whole = whole_of(rows, 0.0)
        if whole is None:
            continue
        tables = world_tables(rows, whole, 0.0)
        header, cells = joined(tables)
        earned = f"{told} earn {spread(whole.columns['reward'])} a shot in the unchanged world. Table:"
        link = out.link(name, "all rows, rewards and models used", header, cells)
        parts.append(f"{side_by_side(tables, 'of the original [%]')}\n\n{earned}\n{link}.")
    return fold("Agents trained anew, four label seeds each", "\n\n".join(parts)) if parts else ""


def world_table(rows: Sequence[Row], known: Sequence[Line], whole: Line, world: str) -> Table:
    """Return what all methods reach on one table."""
    # Where fine-tuning alone was run, its agents before the first step are those that are not adapted.
    first = next(line for line in known if line.method in ("none", "finetuning") and not line.after)
    start = first._replace(method="none")
    few = shown([start, *(line for line in known if line is not first)])
    chosen_on, cells = tuned(rows, world) & set(start.bases), []
    for line in few:
        shares = share(line, whole)
        others = shares[~np.isin(np.intersect1d(line.bases, whole.bases), list(chosen_on))]
        own = [spread(line.columns["reward"]), percent(shares), percent(others) if chosen_on else ""]
        bound = {**BOUNDS_DEG, UNCHANGED: PLAYED[UNCHANGED]}[world]
        cells.append(
            [line.name, *amounts(line, start, adaptation_billiards.STUDY), *own, shares_used(line), f"{bound:g}"]
        )
    header = ["method", *AMOUNTS, "reward", "of the original [%]", "of the original, held-out agents [%]"]
    return Table([*header, "models used", "bound [degrees]"], few, cells)


def joined(tables: dict[str, Table]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of several tables as one, the first column naming the world."""
    header = next(iter(tables.values())).header
    return ["world", *header], [[world, *row] for world, table in tables.items() for row in table.cells]


def side_by_side(tables: dict[str, Table], column: str) -> str:
    """Return a table with a column for each world: one quantity of the methods that short tables show."""
    rows: dict[tuple[int, str], dict[str, str]] = {}
    for world, table in tables.items():
        few = few_of(table.lines)
        for line, cells in zip(table.lines, table.cells, strict=True):
            if any(line is one for one in few):
                name = line.name + (f", {after(line)}" if line.after else "")
                name = line.name + ", most steps" if line.method == "finetuning" else name
                at = list(NAMES).index(line.method)
                rows.setdefault((at, name), {})[world] = cells[table.header.index(column)]
    names = [world.replace("_", " ") for world in tables]
    ordered = sorted(rows.items(), key=lambda item: item[0][0])  # of methods that one world alone has, too
    cells = [[name, *(row.get(world, "") for world in tables)] for (_, name), row in ordered]
    return markdown([column, *names], cells)
