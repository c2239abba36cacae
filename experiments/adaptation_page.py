"""Write the figures and tables of docs/results/adaptation.md from recorded pieces, and nothing else of the page.

    python experiments/adaptation_page.py [--data docs/data/adaptation] [--page docs/results/adaptation.md]

The data are what `adaptation_billiards.py` and `adaptation_navigation.py` leave in their `--out` (TASK/WORLD/PIECE). A
section goes between the lines `<!-- NAME -->` and `<!-- end of NAME -->` of the page. Figures are written beside the
data, whole tables as CSV files in the data's folder `tables`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import _adaptation_overview as overview
import numpy as np
from _adaptation import UNCHANGED
from _adaptation_billiards_tables import billiards, with_label_seeds
from _adaptation_cells import AMOUNTS, Output, Table, after, amounts, shares_used, shown, whole_of
from _adaptation_curves import GAIN_HEADER, curve_points, figure, gain_cells
from _adaptation_overview import on_side
from _adaptation_tables import (
    NAMES,
    Line,
    Row,
    held_out,
    lines,
    matched,
    percent,
    read,
    recovered,
    spread,
    tuned,
)
from _pages import fold, image, rendered
from _trajectories import FILE, draw
from adaptation_navigation import STUDY

SIDES = ("left", "right")
WALKED = {"relative": NAMES["relative"], "intent-180": NAMES["intent"]}  # pieces whose ways are drawn


def outcomes(rows: Sequence[Row], world: str, whole: Line | None) -> Table | None:
    """Return success, collisions and time-outs in a world, and how much of what was lost has come back.

    Args:
        rows: of the study.
        world: the changed world.
        whole: the base agents in the unchanged world; None: the teacher itself is the most that there is to gain.
    """
    known = lines(rows, world)
    start = next((line for line in known if line.method == "none"), None)
    if start is None:
        return None
    teachers = [line for line in known if line.method == "teacher"]
    most = whole or max(teachers, key=lambda line: float(np.mean(line.columns["success"])), default=None)
    chosen_on, cells = tuned(rows, world) & set(start.bases), []
    few = ([whole] if whole else []) + shown(known)
    for line in few:
        name, back, used = "unchanged world" if line is whole else line.name, "", amounts(line, start, STUDY)
        if most is not None and line is not start and line is not most:
            now, before = matched(line, start, "success")
            back = recovered(now, before, matched(most, start, "success")[0])
        held = [held_out(line, "success", chosen_on)] if chosen_on else []
        own = [percent(line.columns["success"]), *held, *(percent(line.columns[name]) for name in WAYS_TO_FAIL)]
        cells.append([name, *used, *own, *([back] if most else []), shares_used(line)])
    gained = ["of the loss [%]" if whole else "of the way to the teacher [%]"] if most else []
    held = ["success, held-out agents [%]"] if chosen_on else []
    header = ["method", *AMOUNTS, "success [%]", *held, "collisions [%]", "time-outs [%]", *gained, "models used"]
    return Table(header, [line if line is not whole else line._replace(variant="unchanged") for line in few], cells)


WAYS_TO_FAIL = ("collision", "timeout")
SHORT = [*AMOUNTS, "success [%]", "collisions [%]", "of the loss [%]"]


def lidar(rows: Sequence[Row], folder: Path, out: Output) -> str:
    """Return the section of the turned lidar."""
    world = "turned_lidar"
    found = outcomes(rows, world, whole_of(rows, 0.0))
    if found is None:
        return ""
    points, links = (
        curve_points(lines(rows, world), "success"),
        [out.link("lidar", "all rows", found.header, found.cells)],
    )
    text = found.short(SHORT)
    if points:
        figure({world: points}, folder / "lidar", "success", None)
        links.append(out.link("lidar_gains", "labels or steps to a gain", GAIN_HEADER, gain_cells(points)))
        text = f"{image('success with a turned lidar', folder / 'lidar', out.page)}\n\n{text}"
    control = outcomes(rows, UNCHANGED, None)
    if control and len(control.lines) > 1:
        links.append(
            out.link("lidar_unchanged", "the same methods in the unchanged world", control.header, control.cells)
        )
    return f"{text}\n\n{out.links(*links)}"


def lidar_with_label_seeds(data: Path, out: Output) -> str:
    """Return the section of walkers trained anew, four label seeds each: eight, and eight further ones."""
    parts = [
        ("lidar_anew", "Eight agents", data / "anew" / "navigation"),
        ("lidar_further", "Eight further agents", data / "anew" / "further" / "navigation"),
    ]
    text = tables(out, [(name, title, outcomes(read(folder), "turned_lidar", None)) for name, title, folder in parts])
    return fold("Agents trained anew, four label seeds each", text) if text else ""


CEILINGS_HEADER = ["cloned from the road map", "actions", "seeds", "success [%]", "collisions [%]", "time-outs [%]"]


def rooms(rows: Sequence[Row], folder: Path, out: Output) -> str:
    """Return the section of rooms, where nothing was lost that could come back, with its ceilings."""
    found = outcomes(rows, "rooms", None)
    if found is None:
        return ""
    links = [out.link("rooms", "all rows", found.header, found.cells)]
    if ceilings := ceiling_cells(folder / "rooms" / "ceilings.json"):
        links.append(out.link("ceilings", "ceilings: clones of the road map", CEILINGS_HEADER, ceilings))
    return f"{found.short([*AMOUNTS, 'success [%]', 'time-outs [%]'])}\n\n{out.links(*links)}"


def ceiling_cells(file: Path) -> list[list[str]]:
    """Return how well rooms can be walked at all: clones of the road map after the most actions."""
    if not file.exists():
        return []
    known, cells = json.loads(file.read_text(encoding="utf-8")), []
    last = max(row["actions"] for row in known)
    for variant in dict.fromkeys(row["variant"] for row in known):
        own = [row for row in known if row["variant"] == variant and row["actions"] in (0, last)]
        shares = (percent(np.array([row[name] for row in own])) for name in ("success", "collision", "timeout"))
        cells.append([variant, f"{own[0]['actions']:,}", str(len(own)), *shares])
    return cells


SIDES_HEADER = ["wanted", "method", *AMOUNTS, "success [%]", "all on the wanted side [%]", "on both sides [%]"]


def side_table(rows: Sequence[Row], world: str, side: str) -> Table:
    """Return a row for each way of adapting in a corridor with a wanted side."""
    cells, known = [], lines(rows, world)
    start = next((line for line in known if line.method == "none"), None)
    for line in known:
        used = amounts(line, start, STUDY) if start else ["", ""]
        wanted, mixed = percent(on_side(line, side)), percent(on_side(line, "both"))
        cells.append([side, line.name, *used, percent(line.columns["success"]), wanted, mixed])
    return Table(SIDES_HEADER, known, cells)


def sides(rows: Sequence[Row], folder: Path, out: Output, name: str = "sides") -> str:
    """Return the section of the preferred side: the share of episodes that passed all obstacles on that side."""
    drawn, tables = {}, [side_table(rows, f"corridor_{side}", side) for side in SIDES]
    for side in SIDES:
        for piece, title in WALKED.items():
            kept = folder / f"corridor_{side}" / piece / FILE
            if kept.exists():
                drawn[f"adapted to pass on the {side}: {title}"] = kept
    cells = [row for table in tables for row in table.cells]
    if not cells:
        return ""
    short = [table.short(SHORT_SIDES).split("\n") for table in tables if table.cells]
    text = "\n".join([*short[0], *(row for rows_of_side in short[1:] for row in rows_of_side[2:])])
    if drawn:
        draw(drawn, folder / "trajectories")
        text = f"{image('ways in a corridor', folder / 'trajectories', out.page)}\n\n{text}"
    return f"{text}\n\n{out.links(out.link(name, 'all rows', SIDES_HEADER, cells))}"


SHORT_SIDES = ["method", "labels", "success [%]", "all on the wanted side [%]"]
SETTINGS_HEADER = ["scale", "world", "method", "after", "bases", "measured", "value"]


def settings(rows: Sequence[Row], metric: str, scale: str) -> list[list[str]]:
    """Return what was compared on tuning episodes, the best first."""
    cells = []
    for world in dict.fromkeys(row["world"] for row in rows if row["split"] == "tuning" and row["world"] != UNCHANGED):
        wanted = f"passed_{world.rpartition('_')[2]}" if world.startswith("corridor_") else metric
        known = [line for line in lines(rows, world, "tuning") if np.isfinite(line.columns[wanted]).all()]
        last = max((line.after for line in known if line.method == "finetuning"), default=0)
        known = [line for line in known if line.method != "finetuning" or line.after == last]
        known.sort(key=lambda line: (list(NAMES).index(line.method), -float(np.mean(line.columns[wanted]))))
        for line in known:
            value = spread(line.columns[wanted])
            cells.append([scale, world, line.name, after(line), str(len(line.bases)), wanted, value])
    return cells


def with_look_ahead(data: Path, out: Output) -> str:
    """Return the section of four agents trained anew, at full size: rooms and sides, with look-ahead."""
    rows = read(data / "anew" / "navigation")
    text = tables(
        out,
        [
            ("rooms_anew", "Rooms, four agents trained anew", outcomes(rows, "rooms", None)),
            ("sides_left_anew", "Pass on the left, the same four", side_table(rows, "corridor_left", "left")),
            ("sides_right_anew", "Pass on the right, the same four", side_table(rows, "corridor_right", "right")),
        ],
    )
    return fold("Tables of rooms and sides with look-ahead", text) if text else ""


def on_two_cores(data: Path, out: Output) -> str:
    """Return the section of smaller runs: the lidar, rooms with look-ahead, sides, the quadruped."""
    small, again = read(data / "cpu" / "navigation"), read(data / "retrained" / "navigation")
    parts = [
        ("lidar_cpu", "A turned lidar", outcomes(small, "turned_lidar", whole_of(small, 0.0))),
        ("rooms_cpu", "Rooms, with look-ahead", outcomes(small, "rooms", None)),
        ("rooms_retrained", "Rooms, seven agents trained anew", outcomes(again, "rooms", None)),
        ("sides_retrained", "Pass on the left, the same seven", side_table(again, "corridor_left", "left")),
        ("quadruped", "The quadruped in halls", outcomes(small, "anymal", None)),
        ("quadruped_sides", "The quadruped, pass on the left", side_table(small, "corridor_left_anymal", "left")),
    ]
    text = tables(out, parts)
    return fold("Tables of the runs on two cores", text) if text else ""


def tables(out: Output, parts: Sequence[tuple[str, str, Table | None]]) -> str:
    """Return short tables of parts (name, title, whole table), with links to the whole ones."""
    shown, links = [], []
    for name, title, table in parts:
        if table and table.cells:
            columns = SHORT_SIDES if table.header == SIDES_HEADER else [*AMOUNTS, "success [%]", "models used"]
            shown.append(f"**{title}**\n\n{table.short(columns)}")
            links.append(out.link(name, title, table.header, table.cells))
    return "\n\n".join([*shown, out.links(*links)]) if shown else ""


def sections(data: Path, page: Path) -> dict[str, str]:
    """Return every section of the page of which there are data; write their figures and tables."""
    out, found = Output(data, page), {}
    scenarios = overview.found_in(data)
    if scenarios:
        overview.draw(scenarios, data / "overview")
        found["overview"] = overview.table(scenarios)
    tasks = {"billiards": {"billiards": billiards}, "navigation": {"lidar": lidar, "rooms": rooms, "sides": sides}}
    compared = []
    for task, parts in tasks.items():
        rows = read(data / task)
        for name, part in parts.items():
            found[name] = part(rows, data / task, out)
        compared += settings(rows, "reward" if task == "billiards" else "success", "paper")
    compared += settings(read(data / "cpu" / "navigation"), "success", "cpu")
    found["label-seeds"] = with_label_seeds(data, out)
    found["lidar-seeds"] = lidar_with_label_seeds(data, out)
    found["look-ahead"] = with_look_ahead(data, out)
    found["two-cores"] = on_two_cores(data, out)
    if compared:
        link = out.link("settings", "settings compared on tuning episodes", SETTINGS_HEADER, compared)
        found["settings"] = out.links(link)
    return {name: text for name, text in found.items() if text}


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("docs/data/adaptation"))
    parser.add_argument("--page", type=Path, default=Path("docs/results/adaptation.md"))
    asked = parser.parse_args(arguments)
    found = sections(asked.data, asked.page)
    asked.page.write_text(rendered(asked.page.read_text(encoding="utf-8"), found), encoding="utf-8")
    print(f"wrote {asked.page}: {', '.join(found) or 'nothing new'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
