"""Writes the tables of docs/results/adaptation.md from recorded pieces, and nothing else of it.

    python experiments/adaptation_page.py --data docs/data/adaptation --page docs/results/adaptation.md

The data are what `adaptation_billiards.py` and `adaptation_navigation.py` leave in their `--out` (TASK/WORLD/PIECE). A
table goes between the lines `<!-- NAME -->` and `<!-- end of NAME -->` of the page, in place of what was there; figures
are written beside the data.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path

import adaptation_billiards
import numpy as np
from _adaptation import UNCHANGED, Study
from _adaptation_tables import (
    GAIN,
    NAMES,
    Line,
    Row,
    first_reaching,
    held_out,
    lines,
    matched,
    name_of,
    percent,
    read,
    recovered,
    rewarded_steps,
    share,
    spread,
    table,
    tuned,
)
from _trajectories import FILE, draw
from adaptation_billiards import BOUNDS_DEG, LEAST, PLAYED
from adaptation_navigation import STUDY
from bootstrapping_page import rendered
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from cuelearner_jax.report.figures import colour_of, save_figure

CURVES = ("relative", "residual", "dcoach", "finetuning")
SIDES = ("left", "right")
WALKED = {"relative": NAMES["relative"], "intent-180": NAMES["intent"]}  # pieces whose ways are drawn
COLOURS = {"residual": "#E69F00", "finetuning": "#4d4d4d"}


def whole_of(rows: Sequence[Row], least: float) -> Line | None:
    """The base agents in the unchanged world."""
    found = lines(rows, UNCHANGED, least=least)
    return found[0] if found else None


def after(line: Line) -> str:
    """Labels or steps, as a cell."""
    if line.method == "finetuning":
        return f"{line.after:,} steps"
    return f"{line.after:,} labels" if line.after else ""


AMOUNTS = ["labels", "rewarded steps"]


def amounts(line: Line, start: Line, study: Study) -> list[str]:
    """Labels and rewarded steps, as cells."""
    labels = f"{line.after:,}" if line.after and line.method != "finetuning" else ""
    steps = rewarded_steps(line, start, study)
    return [labels, "" if steps is None else f"{steps:,}"]


def shown(known: Sequence[Line]) -> list[Line]:
    """What tables show: of fine-tuning a few of its measurements."""
    steps = [line.after for line in known if line.method == "finetuning" and line.after]
    few = {value for value in steps if value in (min(steps), max(steps)) or value * 4 == max(steps)} if steps else set()
    return [line for line in known if line.method != "finetuning" or line.after in few]


def billiards(rows: Sequence[Row], folder: Path, seen: str) -> str:
    """The three worlds: rewards, shares of the original, and when the gain is made."""
    whole = whole_of(rows, LEAST)
    if whole is None:
        return ""
    original = f"The base agents: {len(whole.bases)}, of a reward of {spread(whole.columns['reward'])} unchanged."
    parts, curves = [original], {}
    study = adaptation_billiards.STUDY
    for world, bound in {**BOUNDS_DEG, UNCHANGED: PLAYED[UNCHANGED]}.items():
        known = lines(rows, world, least=LEAST)
        if len(known) < (2 if world == UNCHANGED else 1):  # there the other methods are a control
            continue
        start = next(line for line in known if line.method == "none")
        chosen_on = tuned(rows, world) & set(start.bases)
        cells = []
        for line in shown(known):
            shares = share(line, whole)
            others = shares[~np.isin(np.intersect1d(line.bases, whole.bases), list(chosen_on))]
            own = [spread(line.columns["reward"]), percent(shares), *([percent(others)] if chosen_on else [])]
            cells.append([line.name, *amounts(line, start, study), *own, _used(line)])
        held = ["of the original, held-out agents [%]"] if chosen_on else []
        header = ["", *AMOUNTS, "reward", "of the original [%]", *held, "models used"]
        parts.append(f"**{world}**, bound {bound:g} degrees:\n\n{table(header, cells)}")
        if world == UNCHANGED:
            continue
        curves[world] = curve_points(known, "reward", whole)
        parts.append(_gains(curves[world]))
    if any(curves.values()):
        figure(curves, folder / "shares", "share of the original reward", (1.0, "original"))
        parts.insert(1, f"![reward as a share of the original]({seen}/shares.png)")
    return "\n\n".join(part for part in parts if part)


def _used(line: Line) -> str:
    return f"{100 * line.columns['used'].mean():.0f}%" if "used" in line.columns else ""


# method and variant -> labels or steps, values (bases, label seeds, points)
Points = dict[tuple[str, str], tuple[list[int], np.ndarray]]


def curve_points(known: Sequence[Line], metric: str, whole: Line | None = None) -> Points:
    """What methods reach over labels or steps, from not adapted on, over the bases that all have."""
    start = [line for line in known if line.method == "none"]
    if not start:
        return {}
    found: Points = {}
    made = dict.fromkeys((line.method, line.variant) for line in known if line.method in CURVES)
    for kind in sorted(made, key=lambda kind: CURVES.index(kind[0])):
        own = [line for line in known if (line.method, line.variant) == kind]
        own = own if any(line.after == 0 for line in own) else [*start, *own]
        if len(own) < 2:
            continue
        base = whole or start[0]
        columns = [
            share(line, whole) if whole else matched(line, base, metric)[0]
            for line in sorted(own, key=lambda line: line.after)
        ]
        if len({len(column) for column in columns}) == 1:
            found[kind] = sorted(line.after for line in own), np.stack(np.broadcast_arrays(*columns), axis=-1)
    return found


def _gains(points: Points) -> str:
    """When each method has made its own gain, and that of relative labels."""
    if (CURVES[0], "") not in points:
        return ""
    reference = points[CURVES[0], ""][1][..., [0, -1]]
    rows = []
    for (method, variant), (labels, values) in points.items():
        if len(values) != len(reference):
            continue
        mine, theirs = (first_reaching(values, labels, reference, own) for own in (True, False))
        unit = "steps" if method == "finetuning" else "labels"
        told = ["never gained" if not np.isfinite(mine.estimate) else f"{mine.told(labels[-1])} {unit}"]
        rows.append([name_of(method, variant), *told, f"{theirs.told(labels[-1])} {unit}"])
    header = ["", f"{GAIN:.0%} of its own gain", f"{GAIN:.0%} of the gain of relative labels"]
    return table(header, rows)


def figure(curves: dict[str, Points], stem: Path, ylabel: str, level: tuple[float, str] | None) -> None:
    """Curves over labels and steps on one logarithmic axis, a panel a world."""
    drawn = Figure(figsize=(3.2 * len(curves) + 0.6, 3.2), layout="constrained")
    for axes, (world, points) in zip(drawn.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True):
        for (method, variant), (labels, values) in points.items():
            low, middle, high = np.quantile(values.mean(1), [0.25, 0.5, 0.75], axis=0)
            colour = COLOURS.get(method) or colour_of(method)
            x = np.maximum(labels, 10)  # the first point, of no labels, at the left end
            style = {"color": colour, "linestyle": "--" if variant else "-", "marker": "o", "markersize": 3}
            axes.plot(x, middle, label=name_of(method, variant), **style)
            axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        if level:
            axes.axhline(level[0], color="#999999", linestyle="--", linewidth=1, label=level[1])
        axes.set(xscale="log", title=world.replace("_", " "), xlabel="labels, or steps of fine-tuning")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1_000:g}k" if value >= 1_000 else f"{value:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    drawn.axes[0].set_ylabel(ylabel)
    handles, names = drawn.axes[0].get_legend_handles_labels()
    columns = min(len(names), 5) if len(curves) > 1 else 1
    drawn.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)
    save_figure(drawn, stem)


def outcomes(rows: Sequence[Row], world: str, whole: Line | None) -> str:
    """Success, collisions and time-outs in a world, and how much of what was lost has come back.

    Args:
        rows: of the study.
        world: the changed world.
        whole: the base agents in the unchanged world; None: the teacher itself is the most that there is to gain.
    """
    known = lines(rows, world)
    start = next((line for line in known if line.method == "none"), None)
    if start is None:
        return ""
    teachers = [line for line in known if line.method == "teacher"]
    most = whole or max(teachers, key=lambda line: float(np.mean(line.columns["success"])), default=None)
    chosen_on, cells = tuned(rows, world) & set(start.bases), []
    for line in ([whole] if whole else []) + shown(known):
        name, back, used = "unchanged world" if line is whole else line.name, "", amounts(line, start, STUDY)
        if most is not None and line is not start and line is not most:
            now, before = matched(line, start, "success")
            back = recovered(now, before, matched(most, start, "success")[0])
        held = [held_out(line, "success", chosen_on)] if chosen_on else []
        own = [percent(line.columns["success"]), *held, *(percent(line.columns[name]) for name in WAYS_TO_FAIL)]
        cells.append([name, *used, *own, *([back] if most else []), _used(line)])
    gained = ["of the loss [%]" if whole else "of the way to the teacher [%]"] if most else []
    held = ["success, held-out agents [%]"] if chosen_on else []
    header = ["", *AMOUNTS, "success [%]", *held, "collisions [%]", "time-outs [%]", *gained, "models used"]
    return table(header, cells)


WAYS_TO_FAIL = ("collision", "timeout")


def lidar(rows: Sequence[Row], folder: Path, seen: str) -> str:
    """The turned lidar."""
    world = "turned_lidar"
    text = outcomes(rows, world, whole_of(rows, 0.0))
    points = curve_points(lines(rows, world), "success")
    if points:
        figure({world: points}, folder / "lidar", "success", None)
        text += f"\n\n{_gains(points)}\n\n![success with a turned lidar]({seen}/lidar.png)"
    if len(lines(rows, UNCHANGED)) > 1:
        text += f"\n\nThe same methods in the unchanged world:\n\n{outcomes(rows, UNCHANGED, None)}"
    return text.strip()


def rooms(rows: Sequence[Row], folder: Path, seen: str) -> str:
    """The rooms, where nothing has been lost that could come back; and how well they can be walked at all."""
    text, file = outcomes(rows, "rooms", None), folder / "rooms" / "ceilings.json"
    if not text or not file.exists():
        return text
    known = json.loads(file.read_text(encoding="utf-8"))
    last = max(row["actions"] for row in known)
    cells = []
    for variant in dict.fromkeys(row["variant"] for row in known):
        own = [row for row in known if row["variant"] == variant and row["actions"] in (0, last)]
        told = (percent(np.array([row[name] for row in own])) for name in ("success", "collision", "timeout"))
        cells.append([variant, f"{own[0]['actions']:,}", str(len(own)), *told])
    header = ["cloned from the road map", "actions", "seeds", "success [%]", "collisions [%]", "time-outs [%]"]
    return f"{text}\n\nCeilings:\n\n{table(header, cells)}"


SIDES_HEADER = ["wanted", "", *AMOUNTS, "success [%]", "all on the wanted side [%]", "on both sides [%]"]


def side_cells(rows: Sequence[Row], world: str, side: str) -> list[list[str]]:
    """A row for each way of adapting in a corridor with a wanted side."""
    cells, known = [], lines(rows, world)
    start = next((line for line in known if line.method == "none"), None)
    for line in known:
        used = amounts(line, start, STUDY) if start else ["", ""]
        each = {name: line.columns[f"passed_{name}"] for name in (*SIDES, "both")}
        passed = np.maximum(sum(each.values()), 1e-9)
        wanted, mixed = percent(each[side] / passed), percent(each["both"] / passed)
        cells.append([side, line.name, *used, percent(line.columns["success"]), wanted, mixed])
    return cells


def quadruped(rows: Sequence[Row]) -> str:
    """The quadruped in the halls that its agents know, and in the corridor with a wanted side."""
    halls, corridor = outcomes(rows, "anymal", None), side_cells(rows, "corridor_left_anymal", "left")
    return "\n\n".join(part for part in (halls, table(SIDES_HEADER, corridor) if corridor else "") if part)


def sides(rows: Sequence[Row], folder: Path, seen: str) -> str:
    """The preferred side: of episodes that passed an obstacle, how many passed all of theirs where it was wanted."""
    cells, drawn = [], {}
    for side in SIDES:
        cells += side_cells(rows, f"corridor_{side}", side)
        for piece, name in WALKED.items():
            kept = folder / f"corridor_{side}" / piece / FILE
            if kept.exists():
                drawn[f"adapted to pass on the {side}: {name}"] = kept
    if not cells:
        return ""
    text = table(SIDES_HEADER, cells)
    if drawn:
        draw(drawn, folder / "trajectories")
        text += f"\n\n![ways in a corridor]({seen}/trajectories.png)"
    return text


def settings(rows: Sequence[Row], metric: str) -> str:
    """What was compared on tuning episodes, the best first."""
    parts = []
    for world in dict.fromkeys(row["world"] for row in rows if row["split"] == "tuning" and row["world"] != UNCHANGED):
        wanted = f"passed_{world.rpartition('_')[2]}" if world.startswith("corridor_") else metric
        known = [line for line in lines(rows, world, "tuning") if np.isfinite(line.columns[wanted]).all()]
        last = max((line.after for line in known if line.method == "finetuning"), default=0)
        known = [line for line in known if line.method != "finetuning" or line.after == last]
        known.sort(key=lambda line: (list(NAMES).index(line.method), -float(np.mean(line.columns[wanted]))))
        cells = [[line.name, after(line), str(len(line.bases)), spread(line.columns[wanted])] for line in known]
        parts.append(f"**{world}**:\n\n{table(['', 'after', 'bases', wanted], cells)}")
    return "\n\n".join(parts)


def sections(data: Path, page: Path) -> dict[str, str]:
    """The text of every part of the page of which there are data."""
    found = {}
    tasks = {"billiards": {"billiards": billiards}, "navigation": {"lidar": lidar, "rooms": rooms, "sides": sides}}
    for task, parts in tasks.items():
        folder = data / task
        rows = read(folder)
        seen = Path(os.path.relpath(folder, page.parent)).as_posix()
        for name, part in parts.items():
            found[name] = part(rows, folder, seen)
        found[f"{task}-settings"] = settings(rows, "reward" if task == "billiards" else "success")
    rows = read(data / "cpu" / "navigation")  # of the scale of that name, its base agents among them
    found["lidar-cpu"] = outcomes(rows, "turned_lidar", whole_of(rows, 0.0))
    found["rooms-cpu"] = outcomes(rows, "rooms", None)
    found["quadruped-cpu"] = quadruped(rows)
    found["navigation-cpu-settings"] = settings(rows, "success")
    again = data / "retrained" / "navigation"  # at that scale too, of agents trained once more
    rows = read(again)
    found["rooms-retrained"] = outcomes(rows, "rooms", None)
    found["sides-retrained"] = sides(rows, again, Path(os.path.relpath(again, page.parent)).as_posix())
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
