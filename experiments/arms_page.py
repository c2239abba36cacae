"""Write the figure and the table of docs/results/arms.md from recorded data, and nothing else of the page.

    python experiments/arms_page.py [--data docs/data/arms] [--page docs/results/arms.md]

The data are `training_WORLD.json` of `arms.py`, what `cuelearner evaluate --out` wrote of agents in MJX and in Fetch,
and `reach_settings.json`. Three sections go between the page's lines `<!-- NAME -->` and `<!-- end of NAME -->`.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path

import matplotlib
import numpy as np
from _pages import GREY, fold, image, markdown, name_ends, new_figure, rendered
from _pieces import grouped
from matplotlib.ticker import EngFormatter

from cuelearner_jax.evaluate import mean_interval
from cuelearner_jax.report.figures import STYLE, colour_of, save_figure

PLACES = {
    "mjx": "in MJX",
    "fetch": "in Fetch, unchanged",
    "fetch_turned": "in Fetch, camera turned by 10 degrees",
    "fetch_turned_calibrated": "the same world, after 200 labels",
}
AGENTS = {
    "reach": "`reach`, one agent",
    "push_free": "`push` without a post, 8 agents",
    "pick": "`pick`, 8 agents",
}
STEPS = (3_200, 6_400, 9_600, 12_800)


TRAINED = ("pick", "push")  # worlds of the table
# Of the table behind a fold; `pressed`: before targets kept above the table.
FOLDED = ("push_in_fetch", "push_in_fetch_pressed", "push_free", "reach", "reach_in_fetch")
RUNS = {
    "alone": "SAC alone",
    "alone_10": "SAC alone, ten critics",
    "by_value": "{labels} {labelled}, compared by value",
    "acting": "{labels} {labelled}, compared while acting",
    "own_policy": "{labels} {labelled}, compared in training",
    "shuffled": "control: {labels} shuffled answers, compared by value",
    "rlpd": "{labels} {labelled}, a policy of them",
    "stored": "{labels} {labelled}, corrected steps",
    "stored_random": "control: {labels} answers at random, corrected steps",
}
LABELLED = {"relative": "relative labels", "demonstration": "demonstrations"}
HEURISTIC = "control: the script compared by value, no label"
DRAWN = {"alone": "-", "stored": "-", "acting": "--"}  # runs that are drawn, with 500 labels


def studied(data: Path, world: str) -> dict[str, list[dict]]:
    """Return the recorded rows of a world of the study: training, steps and guides."""
    return json.loads((data / f"training_{world}.json").read_text(encoding="utf-8"))


def run_name(row: dict) -> str:
    """Return the name of a run of the study."""
    if row["guidance"] == "heuristic":
        return HEURISTIC
    return RUNS[row["run"]].format(labels=row["labels"], labelled=LABELLED.get(row["guidance"], ""))


def training(data: Path, worlds: Sequence[str]) -> str:
    """Return the table of steps to 80% success, with the ratio to the agent alone."""
    cells = []
    for world in worlds:
        found = studied(data, world)
        named = itemgetter("run", "guidance", "labels")
        guides = {named(row): row["mean"] for row in found["guides"]}
        for row in found["steps"]:
            ratio = "{:.2f} [{:.2f}, {:.2f}]".format(*row["ratio"]) if "ratio" in row and row["reached"] else ""
            guide = guides.get(named(row))
            alone = "" if guide is None else f"{100 * guide:.0f}%"
            last = row["end"]["step"]
            end = f"{100 * row['end']['mean']:.0f}% at {EngFormatter(sep='')(last)}"
            median = f"above {last:,}" if row["median"] is None else f"{row['median']:,.0f}"
            cells.append([f"`{world}`, {run_name(row)}", alone, median, ratio, end])
    header = ["8 seeds", "guide alone", "steps to 80%, median", "of the steps alone", "success at the last step"]
    return markdown(header, cells)


def draw_training(data: Path, stem: Path) -> None:
    """Draw success over steps, with labels and without."""
    with matplotlib.rc_context(STYLE):
        figure = new_figure(11, 3.8)
        for axes, world in zip(figure.subplots(1, 2), ("push", "pick"), strict=True):
            rows = studied(data, world)["training"]
            ends = []
            for (run, guidance, labels), own in grouped(rows, "run", "guidance", "labels"):
                if run not in DRAWN or labels == 100 or guidance == "heuristic":
                    continue
                steps, means = [row["step"] for row in own], [row["mean"] for row in own]
                colour = GREY if run == "alone" else colour_of(guidance)
                low, high = [row["low"] for row in own], [row["high"] for row in own]
                axes.fill_between(steps, low, high, color=colour, alpha=0.12, linewidth=0)
                axes.plot(steps, means, color=colour, linewidth=1.8, linestyle=DRAWN[run])
                ends.append((means[-1], run_name(own[0]), colour))
            axes.set(
                xlim=(0, max(row["step"] for row in rows)),
                ylim=(0, 1.03),
                xlabel="environment steps of a seed",
                ylabel="success",
            )
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.set_title(world, fontweight="bold", fontsize=11)
            name_ends(axes, ends)
        save_figure(figure, stem)


def measured(data: Path) -> dict[str, dict[str, list[float]]]:
    """Return the success of each skill's agents in each place: mean, and ends of the interval over agents."""
    found: dict[str, dict[str, list[float]]] = {}
    for skill, place in itertools.product(AGENTS, PLACES):
        file = data / f"{skill}_{place}.json"
        if not file.exists():  # not run
            continue
        each = json.loads(file.read_text())["rows"][0]["success"]
        interval = mean_interval(np.array(each, float)).tolist() if len(each) > 1 else [each[0]] * 3
        found.setdefault(skill, {})[place] = interval
    return found


def transfer(found: dict[str, dict[str, list[float]]]) -> str:
    """Return the table of agents in MJX and in Fetch."""
    cells = [
        [told, *(_percent(found[skill][place]) if place in found[skill] else "not run" for skill in AGENTS)]
        for place, told in PLACES.items()
    ]
    return markdown(["success [%]", *AGENTS.values()], cells)


def _percent(interval: list[float]) -> str:
    mean, low, high = (100 * value for value in interval)
    return f"{mean:.1f} [{low:.1f}, {high:.1f}]" if high > low else f"{mean:.0f}"


def settings(data: Path) -> str:
    """Return the table of success under guidance and arbiter, the seeds side by side."""
    rows = json.loads((data / "reach_settings.json").read_text())["rows"]
    cells = []
    for guidance, arbiter in dict.fromkeys((row["guidance"], row["arbiter"]) for row in rows):
        own = [row for row in rows if (row["guidance"], row["arbiter"]) == (guidance, arbiter)]
        at = {(row["step"], row["seed"]): row["success"] for row in own}
        shown = [", ".join(f"{at[step, seed]:.2f}" for seed in (0, 1)) for step in STEPS]
        cells.append([guidance if guidance == "none" else f"{guidance}, `{arbiter}`", *shown])
    return markdown(["guidance", *(f"{step:,} steps" for step in STEPS)], cells)


def draw(found: dict[str, dict[str, list[float]]], stem: Path) -> None:
    """Draw the success of both skills' agents in every place."""
    with matplotlib.rc_context(STYLE):
        figure = new_figure(11, 2.6)
        for axes, (skill, told) in zip(figure.subplots(1, len(AGENTS), sharey=True), AGENTS.items(), strict=True):
            for row, place in enumerate(PLACES):
                if place not in found[skill]:
                    continue
                mean, low, high = (100 * value for value in found[skill][place])
                colour = colour_of("calibration") if place.endswith("calibrated") else GREY
                axes.barh(row, mean, color=colour, xerr=[[mean - low], [high - mean]], ecolor="0.25")
                axes.text(max(mean, high) + 2, row, f"{mean:.0f}%", va="center", fontsize=9)
            axes.set_yticks(range(len(PLACES)), list(PLACES.values()))
            axes.set_title(told.replace("`", "").replace(", ", "\n"), fontweight="bold", fontsize=11)
            axes.set(xlim=(0, 115), xlabel="success [%]")
            axes.set_xticks(range(0, 101, 20))
            axes.grid(visible=False, axis="y")
            axes.tick_params(axis="y", length=0)
        axes.invert_yaxis()
        save_figure(figure, stem)


def sections(data: Path, page: Path) -> dict[str, str]:
    """Return the sections of the page."""
    picture = image("success of agents in MJX and in Fetch", data / "transfer", page)
    curves = image("success of an arm over steps, with labels and without", data / "training", page)
    folded = fold("Push in Fetch and without a post, and reach", training(data, FOLDED))
    study = f"{curves}\n\n{training(data, TRAINED)}\n\n{folded}"
    return {"training": study, "transfer": f"{picture}\n\n{transfer(measured(data))}", "settings": settings(data)}


def main() -> int:
    """Write the figure and the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("docs/data/arms"))
    parser.add_argument("--page", type=Path, default=Path("docs/results/arms.md"))
    given = parser.parse_args()
    draw_training(given.data, given.data / "training")
    draw(measured(given.data), given.data / "transfer")
    page = rendered(given.page.read_text(encoding="utf-8"), sections(given.data, given.page))
    given.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
