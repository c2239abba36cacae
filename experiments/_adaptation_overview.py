"""The figure and the table that begin docs/results/adaptation.md: every scenario before and after 250 labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from _adaptation import UNCHANGED
from _adaptation_tables import Line, Row, lines, read, share
from _pages import GREY, markdown, new_figure
from adaptation_billiards import LEAST
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from cuelearner_jax.report.figures import STYLE, colour_of, save_figure
from cuelearner_jax.report.statistics import Interval, interval_of_groups

BUDGET = 250
TEACHER, TUNED = "#000000", "#E69F00"


class Scenario(NamedTuple):
    """A changed world or wish, and the method whose labels are shown."""

    title: str
    measured: str
    folder: str  # in the data
    world: str
    method: str
    variant: str = ""
    side: str = ""
    teacher: str = ""  # variant of the teacher within the bound


class Found(NamedTuple):
    """What was measured in a scenario, each in percent; None: not run."""

    scenario: Scenario
    before: Interval
    labels: Interval
    tuned: Interval | None  # after the most steps of fine-tuning
    steps: int
    teacher: Interval | None


OF_ORIGINAL, SUCCESS, SIDE = "reward, % of the original", "success [%]", "on the wanted side [%]"
SCENARIOS = (
    Scenario("Strike turned by 0.8 degrees", OF_ORIGINAL, "billiards", "turned_strike", "relative"),
    Scenario("Balls seen 7 mm off", OF_ORIGINAL, "billiards", "shifted_balls", "relative"),
    Scenario("Tilted table", OF_ORIGINAL, "billiards", "tilted_table", "relative"),
    Scenario("Lidar turned by 15 degrees", SUCCESS, "navigation", "turned_lidar", "relative", "narrowed"),
    Scenario("Rooms", SUCCESS, "navigation", "rooms", "intent", "180-memory", teacher="180"),
    Scenario("Rooms, look-ahead*", SUCCESS, "cpu/navigation", "rooms", "intent", "180-look-ahead"),
    Scenario("Corridor, pass on the left", SIDE, "navigation", "corridor_left", "intent", "180", "left"),
    Scenario("Corridor, pass on the right", SIDE, "navigation", "corridor_right", "intent", "180", "right"),
    Scenario("Quadruped in halls*", SUCCESS, "cpu/navigation", "anymal", "relative"),
    Scenario("Quadruped, pass on the left*", SIDE, "cpu/navigation", "corridor_left_anymal", "relative", "", "left"),
)


@cache
def found_in(data: Path) -> list[Found]:
    """Return what was measured in every scenario of which there are data."""
    rows = {folder: read(data / folder) for folder in dict.fromkeys(scenario.folder for scenario in SCENARIOS)}
    found = []
    for scenario in SCENARIOS:
        least = LEAST if scenario.measured == OF_ORIGINAL else 0.0
        known = lines(rows[scenario.folder], scenario.world, least=least)
        value = values_of(scenario, rows[scenario.folder])
        before = [line for line in known if line.method == "none"]
        labels = [line for line in known if (line.method, line.variant) == (scenario.method, scenario.variant)]
        labels = [line for line in labels if line.after == BUDGET]
        if value is None or not before or not labels:
            continue
        tuned = max((line for line in known if line.method == "finetuning"), key=lambda line: line.after, default=None)
        teacher = [line for line in known if (line.method, line.variant) == ("teacher", scenario.teacher)]
        found.append(
            Found(
                scenario,
                value(before[0]),
                value(labels[0]),
                value(tuned) if tuned else None,
                tuned.after if tuned else 0,
                value(teacher[0]) if teacher else None,
            )
        )
    return found


def values_of(scenario: Scenario, rows: Sequence[Row]) -> Callable[[Line], Interval] | None:
    """Return the function that gives a line's value in percent; None where the unchanged world is missing."""
    if scenario.measured == SUCCESS:
        return lambda line: percent(line.columns["success"])
    if scenario.measured == SIDE:
        return lambda line: percent(on_side(line, scenario.side))
    whole = lines(rows, UNCHANGED, least=LEAST)
    return (lambda line: percent(share(line, whole[0]))) if whole else None


def on_side(line: Line, side: str) -> np.ndarray:
    """Return, of the episodes that passed an obstacle, the share that passed all of them on a side."""
    passed = sum(line.columns[f"passed_{name}"] for name in ("left", "right", "both"))
    return line.columns[f"passed_{side}"] / np.maximum(passed, 1e-9)


def percent(values: np.ndarray) -> Interval:
    """Return the interquartile mean over base agents with its interval, in percent."""
    return interval_of_groups(100 * values.reshape(len(values), -1))


def table(found: Sequence[Found]) -> str:
    """Return the page's first table."""
    header = ["scenario", "measured", "not adapted", f"{BUDGET} labels", "fine-tuning", "the teacher itself"]
    cells = []
    for each in found:
        tuned = f"{each.tuned.estimate:.0f} ({each.steps:,} steps)" if each.tuned else ""
        teacher = f"{each.teacher.estimate:.0f}" if each.teacher else ""
        values = [f"{each.before.estimate:.0f}", f"{each.labels.estimate:.0f}", tuned, teacher]
        cells.append([each.scenario.title.replace("*", "\\*"), each.scenario.measured, *values])
    return markdown(header, cells)


def draw(found: Sequence[Found], stem: Path) -> None:
    """Draw every scenario: from not adapted to 250 labels, beside fine-tuning and the teacher."""
    with matplotlib.rc_context(STYLE):
        figure = new_figure(9, 1.4 + 0.5 * len(found))
        axes = figure.subplots()
        for place, each in enumerate(found):
            blue = colour_of(each.scenario.method if each.scenario.method == "relative" else "intent")
            _point(axes, each.before, place, GREY, "o", hollow=True)
            _point(axes, each.labels, place, blue, "o")
            ends = float(each.before.estimate), float(each.labels.estimate)
            if abs(ends[1] - ends[0]) > 2:
                axes.annotate("", (ends[1], place), (ends[0], place), arrowprops={"arrowstyle": "->", "color": blue})
            if each.tuned:
                _point(axes, each.tuned, place + 0.22, TUNED, "D")
            if each.teacher:
                axes.plot(float(each.teacher.estimate), place, "|", color=TEACHER, markersize=16, markeredgewidth=2)
            told = f"{ends[0]:.0f} to {ends[1]:.0f}"
            axes.text(1.02, place, told, transform=axes.get_yaxis_transform(), va="center", fontsize=9)
        _names(axes, found)
        save_figure(figure, stem)


def _point(axes: Axes, found: Interval, place: float, colour: str, marker: str, hollow: bool = False) -> None:
    if not np.isnan(found.lower):
        axes.plot([float(found.lower), float(found.upper)], [place, place], color=colour, linewidth=2.4, alpha=0.35)
    face = "white" if hollow else colour
    axes.plot(float(found.estimate), place, marker, color=colour, markerfacecolor=face, markersize=7, zorder=3)


def _names(axes: Axes, found: Sequence[Found]) -> None:
    """Name the rows, and above the axes what each mark means."""
    axes.set_yticks(
        range(len(found)), [f"{each.scenario.title}\n{each.scenario.measured}" for each in found], fontsize=9
    )
    axes.set_ylim(len(found) - 0.4, -0.6)
    axes.set_xlim(0, 122)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("percent")
    marks = [
        ("o", GREY, "white", "not adapted"),
        ("o", colour_of("relative"), colour_of("relative"), "250 relative labels"),
    ]
    marks += [("o", colour_of("intent"), colour_of("intent"), "250, read as intent")]
    marks += [("D", TUNED, TUNED, "fine-tuning"), ("|", TEACHER, TEACHER, "the teacher itself")]
    handles = [
        Line2D([], [], linestyle="", marker=mark, color=colour, markerfacecolor=face, label=name)
        for mark, colour, face, name in marks
    ]
    axes.legend(handles=handles, loc="lower left", bbox_to_anchor=(-0.35, 1.0), ncols=5, fontsize=9, handletextpad=0.2)
