"""Figures of docs/results.md, and the recorded values that its tables and figures share."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import fetch_page
import matplotlib
import numpy as np
import pyarrow.compute as pc
from _pages import DOCS, GREY, Bar, forest, interval_of, name_ends, new_figure, read_csv
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter

from cuelearner_jax.report.figures import STYLE, colour_of, save_figure
from cuelearner_jax.report.statistics import Interval, curve, interval
from cuelearner_jax.storage import results

DATA = DOCS / "data"
BENCHMARKS = DOCS.parent / "benchmarks" / "results"
NAMES = {"none": "no guidance", "heuristic": "heuristic", "relative": "relative"}


# --- recorded values -------------------------------------------------------------------------------------------------


@cache
def values(run: str, guidance: str, labels: int, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the evaluated steps, and a metric of every seed at them, (seeds, steps)."""
    table = results.read(DATA / run)
    own = table.filter((pc.field("guidance") == guidance) & (pc.field("labels") == labels))
    steps = np.unique(own["step"].to_numpy())
    columns = [own.filter(pc.field("step") == step)[metric].to_pylist() for step in steps]
    whole = [place for place, column in enumerate(columns) if None not in column and len(column) == len(columns[0])]
    return steps[whole], np.array([columns[place] for place in whole]).T


def at(run: str, guidance: str, labels: int, step: int, metric: str = "success") -> Interval:
    """Return the interquartile mean over seeds at a step."""
    steps, seeds = values(run, guidance, labels, metric)
    return interval(seeds[:, list(steps).index(step)])


def efficiency(world: str, run: str, guidance: str, labels: int) -> dict[str, Any]:
    """Return a row of a world's `efficiency.csv`."""
    rows = read_csv(DATA / "bootstrapping" / world / "report" / "efficiency.csv")
    return next(row for row in rows if (row["run"], row["guidance"], row["labels"]) == (run, guidance, labels))


def benchmark(name: str) -> dict[str, Any]:
    """Return a recorded measurement of benchmarks/results."""
    return json.loads((BENCHMARKS / f"{name}.json").read_text(encoding="utf-8"))


# --- figures ---------------------------------------------------------------------------------------------------------


def lines_of(axes: Axes, run: str, kinds: Sequence[tuple[str, int]], metric: str) -> None:
    """Draw learning curves with their intervals, each named at its end."""
    ends = []
    for kind, labels in kinds:
        steps, estimate, lower, upper = curve(*values(run, kind, labels, metric))
        colour = GREY if kind == "none" else colour_of(kind)
        style = {100: ":", 350: "--"}.get(labels, "-") if len(kinds) > 2 else "-"
        axes.fill_between(steps, lower, upper, color=colour, alpha=0.14, linewidth=0)
        axes.plot(steps, estimate, color=colour, linewidth=1.8, linestyle=style)
        name = NAMES[kind] + (f", {labels} labels" if labels else "") + (" (dotted)" if style == ":" else "")
        ends.append((float(estimate[-1]), name, colour))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("environment steps of a seed")
    name_ends(axes, ends)


def draw_billiards(stem: Path) -> None:
    """Draw the one-ball curves beside the mean rewards on the regulation table."""
    bars = []
    for name, run, kind, labels in (
        ("teacher's own shots", "frame", "perfect-regulation", 0),
        ("intent, 500, paced", "paced", "intent", 500),
        ("intent, 500", "frame", "intent", 500),
        ("relative, 500, paced", "paced", "relative", 500),
        ("relative, 100,000", "frame", "relative", 100_000),
        ("relative, 500", "frame", "relative", 500),
        ("demonstration, 500", "frame", "demonstration", 500),
    ):
        found = interval_of(efficiency("regulation", run, kind, labels), "mean_ratio")
        assert found is not None
        bars.append(Bar(name, found, "#882255" if kind.startswith("perfect") else colour_of(kind)))
    with matplotlib.rc_context(STYLE):
        figure = new_figure(11, 3.8)
        left, right = figure.subplots(1, 2)
        lines_of(left, "quickstart", [("relative", 100), ("none", 0)], "reward")
        left.set_ylabel("reward a shot")
        left.set_title("One ball, from scratch", fontweight="bold", fontsize=11)
        forest(right, bars, Interval(np.array(1.0), np.array(np.nan), np.array(np.nan)))
        right.set_xlim(0, 1.6)
        right.set_xlabel("mean reward over 550,000 steps, no guidance = 1")
        right.set_title("Regulation table, from scratch", fontweight="bold", fontsize=11)
        save_figure(figure, stem)


def draw_navigation(stem: Path) -> None:
    """Draw success over steps in cluttered halls."""
    with matplotlib.rc_context(STYLE):
        figure = new_figure(9, 4)
        axes = figure.subplots()
        axes.set_ylabel("success")
        lines_of(axes, "navigation", [("relative", 500), ("relative", 100), ("heuristic", 0), ("none", 0)], "success")
        save_figure(figure, stem)


def draw_arms(stem: Path) -> None:
    """Draw success of scripted arms with a displaced camera, a panel an environment."""
    found = [line for line in fetch_page.lines(fetch_page.read(DATA / "fetch")) if line.says in ("", "all")]
    fetch_page.draw(found, stem)


def draw_quadruped(stem: Path) -> None:
    """Draw success of one agent on the simple robot, on legs in MJX and in C MuJoCo."""
    rows = json.loads((DATA / "anymal_navigation.json").read_text())["rows"]
    robots = {"simple": ("simple robot", GREY), "anymal": ("quadruped, MJX", "#0072B2")}
    robots["anymal, C MuJoCo"] = ("quadruped, C MuJoCo (50 episodes)", "#E69F00")
    styles = ("clutter", "corridor", "rooms")
    with matplotlib.rc_context(STYLE):
        figure = new_figure(9, 3.2)
        axes = figure.subplots()
        for shift, (robot, (name, colour)) in enumerate(robots.items()):
            own = {row["style"]: row for row in rows if row["robot"] == robot}
            heights = [100 * own[style]["success"] for style in styles]
            places = np.arange(len(styles)) + 0.27 * (shift - 1)
            axes.bar(places, heights, width=0.25, color=colour, label=name)
            for place, height in zip(places, heights, strict=True):
                axes.text(place, height + 1.5, f"{height:.0f}", ha="center", fontsize=9)
        axes.set_xticks(range(len(styles)), styles)
        axes.set(ylim=(0, 112), ylabel="success [%]")
        axes.grid(visible=False, axis="x")
        axes.legend(loc="upper right", fontsize=9)
        save_figure(figure, stem)


def draw_engines(stem: Path) -> None:
    """Draw the reward of aimed shots here and in Chipmunk at two steps."""
    rows = benchmark("aimed_parity")["rows"]
    with matplotlib.rc_context(STYLE):
        figure = new_figure(8, 2.6)
        axes = figure.subplots()
        names, place = [], 0.0
        for table in dict.fromkeys(row["table"] for row in rows):
            own = [row for row in rows if row["table"] == table]
            bars = [("here", own[0]["reward"], "#0072B2")]
            bars += [(f"Chipmunk, step {1e3 * row['step_s']:g} ms", row["reward_in_chipmunk"], GREY) for row in own]
            for name, reward, colour in bars:
                axes.barh(place, reward, color=colour, height=0.8)
                axes.text(reward + 0.006, place, f"{reward:.2f}", va="center", fontsize=9)
                names.append((place, f"{table}: {name}"))
                place += 1
            place += 0.6
        axes.set_yticks([at for at, _ in names], [name for _, name in names])
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        axes.set_xlabel("reward a shot at random possible aims, 1,000 shots")
        save_figure(figure, stem)
