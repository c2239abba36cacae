"""Write the figures and the tables of findings of docs/results.md from recorded data, and nothing else of the page.

    python experiments/results_page.py [--page docs/results.md]

A task has a figure in docs/figures and a table between the lines `<!-- TASK -->` and `<!-- end of TASK -->` of the
page. Every number is computed from docs/data or benchmarks/results; the tables of the other result pages are read as
their generators left them, so run those first.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import _adaptation_overview as adaptation
import arms_page
import fetch_page
import numpy as np
from _pages import DOCS, image, interval_of, markdown, read_csv, rendered
from _results_figures import (
    DATA,
    at,
    benchmark,
    draw_arms,
    draw_billiards,
    draw_engines,
    draw_navigation,
    draw_quadruped,
    efficiency,
)

from cuelearner_jax.report.statistics import Interval, interval

FIGURES = DOCS / "figures"
HEADER = ["finding", "with labels", "without labels", "more"]
LEFT_OUT = ("Tilted table", "Corridor, pass on the right")  # scenarios that say what another one says
MORE = {
    "one": "[one ball](results/training.md#one-ball)",
    "three": "[three balls](results/training.md#three-balls-raw-coordinates)",
    "navigation": "[navigation](results/training.md#navigation)",
    "labels": "[how far labels carry](results/bootstrapping.md)",
    "adaptation": "[what adaptation gains](results/adaptation.md)",
    "fetch": "[a displaced camera](results/fetch.md)",
    "corrections": "[corrections alone](results/corrections.md)",
    "arms": "[arms](results/arms.md)",
    "anymal": "[the quadruped](anymal.md)",
    "engines": "[simulators](results/engines.md)",
    "speed": "[speed](results/engines.md#speed)",
}


def number(found: Interval, digits: int = 2) -> str:
    """Return an estimate as a cell; intervals stand on the pages of the studies."""
    return f"{float(found.estimate):.{digits}f}"


def percentage(found: Interval) -> str:
    """Return an estimate of a share as a cell."""
    return f"{100 * float(found.estimate):.0f}%"


# --- tables ----------------------------------------------------------------------------------------------------------


def billiards() -> list[list[str]]:
    """Return the findings in billiards."""
    one = [at("quickstart", kind, labels, 3_000, "reward") for kind, labels in (("relative", 100), ("none", 0))]
    three = [
        at("billiards_easy/plain", kind, labels, 200_000, "reward") for kind, labels in (("relative", 500), ("none", 0))
    ]
    seen = read_csv(DATA / "bootstrapping/regulation/report/summary.csv")[0]
    raw = at("billiards_paper", "none", 0, 3_000_000, "reward")
    ratio = {
        name: f"{efficiency('regulation', run, kind, labels)['mean_ratio']:.2f} times"
        for name, run, kind, labels in (
            ("intent", "paced", "intent", 500),
            ("relative", "frame", "relative", 500),
            ("many", "frame", "relative", 100_000),
        )
    }
    long = efficiency("full", "raw", "relative", 1_000)["steps_ratio"]
    return [
        ["One ball, 100 labels: reward a shot after 3,000 steps", number(one[0]), number(one[1]), MORE["one"]],
        ["Three balls, raw coordinates, 500 labels: reward a shot", number(three[0]), number(three[1]), MORE["three"]],
        ["Regulation table, 500 labels as `intent`: mean reward", ratio["intent"], "1", MORE["labels"]],
        ["The same, 500 relative labels: slower", ratio["relative"], "1", MORE["labels"]],
        ["The same, 100,000 relative labels: still slower", ratio["many"], "1", MORE["labels"]],
        ["The paper's setting, 1,000 labels: steps to the last level", f"{long:.2f} times", "1", MORE["labels"]],
        [
            "No labels, seen from the strike (raw coordinates): reward a shot",
            "",
            f"{seen['final']:.2f} ({number(raw)})",
            MORE["labels"],
        ],
    ]


def navigation() -> list[list[str]]:
    """Return the findings in navigation."""
    run, found = "navigation", []
    for step in (50_000, 140_000):
        labels, none = at(run, "relative", 500, step), at(run, "none", 0, step)
        found.append(
            [f"500 labels: success after {step:,} steps", percentage(labels), percentage(none), MORE["navigation"]]
        )
    heuristic = at(run, "heuristic", 0, 50_000)
    found.append(
        [
            "Walking straight at the goal, no labels: the same after 50,000",
            "",
            percentage(heuristic),
            MORE["navigation"],
        ]
    )
    hundred, none = efficiency("clutter", "frame", "relative", 100), efficiency("clutter", "frame", "none", 0)
    steps = f"{hundred['steps_to_level']:,.0f}", f"more than {none['steps_to_level_above']:,.0f}"
    found.append(["100 labels, seen from the action: steps to 90% success", *steps, MORE["labels"]])
    wrong = interval_of(efficiency("cpu/clutter", "flipped-20", "relative", 500), "mean")
    right = interval_of(efficiency("cpu/clutter", "frame", "relative", 500), "mean")
    nothing = interval_of(efficiency("cpu/clutter", "frame", "none", 0), "mean")
    assert wrong is not None
    assert right is not None
    assert nothing is not None
    cell = f"{number(wrong)} (all right: {number(right)})"
    found.append(["20% of 500 answers wrong: mean success, two cores", cell, number(nothing), MORE["labels"]])
    (rooms,) = json.loads((DATA / "navigation/evaluations/relative-500-agent-rooms.json").read_text())["rows"]
    found.append(
        [
            "500 labels: success in rooms, never seen in training",
            percentage(interval(np.array(rooms["success"]))),
            "",
            MORE["navigation"],
        ]
    )
    return found


def adapted() -> list[list[str]]:
    """Return the findings about finished policies in changed worlds."""
    rows = []
    for each in adaptation.found_in(DATA / "adaptation"):
        if each.scenario.title in LEFT_OUT:
            continue
        title = each.scenario.title.replace("*", ", two cores")
        tuned = f"; fine-tuning {each.tuned.estimate:.0f}%" if each.tuned else ""
        measured = each.scenario.measured.replace(" [%]", "").replace("% of", "share of")
        cells = [f"{each.labels.estimate:.0f}%{tuned}", f"{each.before.estimate:.0f}%"]
        rows.append([f"{title}, 250 labels: {measured}", *cells, MORE["adaptation"]])
    return rows


def arms() -> list[list[str]]:
    """Return the findings about arms."""
    found = {
        (line.environment, line.what, line.says, line.shuffled): line
        for line in fetch_page.lines(fetch_page.read(DATA / "fetch"))
    }
    rows = []
    for environment, what in (
        ("FetchPush-v4", "calibration"),
        ("FetchReach-v4", "calibration"),
        ("FetchPush-v4", "relative"),
    ):
        before = found[environment, "displaced", "", False].success
        after = found[environment, what, "all", False].success
        title = f"{environment.partition('-')[0]}, camera 3 cm off, 100 labels of `{what}`: success"
        rows.append([title, f"{after:g}%", f"{before:g}%", MORE["fetch"]])
    success = {
        (row["world"], row["kind"], row["teacher"], row["labels"]): row["success"]
        for row in read_csv(DATA / "corrections_alone/success.csv")
    }
    base = success["turned", "base", "plain", 0]
    for kind, name in (("calibration", "`calibration`"), ("offset", "`offset`"), ("dcoach", "deep COACH")):
        title = f"MJX `reach`, camera turned by 10 degrees, 20% of 100 answers wrong, {name}: success"
        rows.append(
            [title, f"{100 * success['turned', kind, 'wrong', 100]:.0f}%", f"{100 * base:.0f}%", MORE["corrections"]]
        )
    turned = [
        json.loads((DATA / f"arms/reach_fetch_turned{end}.json").read_text())["rows"][0]["success"][0]
        for end in ("_calibrated", "")
    ]
    for skill, run, labels, told in (
        ("pick", "stored", 500, "500 relative labels correct executed steps"),
        ("push", "stored", 100, "100 relative labels correct executed steps"),
        ("reach", "by_value", 100, "100 relative labels, no gain"),
    ):
        studied = arms_page.studied(DATA / "arms", skill)["steps"]
        steps = {(row["run"], row["labels"]): row["median"] for row in studied if row["guidance"] != "demonstration"}
        title = f"MJX `{skill}`, {told}: steps to 80% success"
        rows.append([title, f"{steps[run, labels]:,.0f}", f"{steps['alone', 0]:,.0f}", MORE["arms"]])
    title = "An MJX agent in Fetch, camera turned by 10 degrees, 200 labels: success"
    rows.append([title, *(f"{100 * value:.0f}%" for value in turned), MORE["arms"]])
    return rows


def quadruped() -> list[list[str]]:
    """Return the findings about the quadruped."""
    rows = json.loads((DATA / "anymal_navigation.json").read_text())["rows"]
    found = {(row["style"], row["robot"], row["episodes"]): row["success"] for row in rows}
    cells = []
    for style in ("clutter", "corridor", "rooms"):
        values = (f"{100 * found[style, robot, 500]:.1f}%" for robot in ("anymal", "simple"))
        cells.append([f"Unchanged agent in `{style}`: success", *values, MORE["anymal"]])
    return cells


def simulators() -> list[list[str]]:
    """Return the findings about simulators and speed, each beside what was asked for."""
    parity, beams = benchmark("billiards_parity")["rows"], benchmark("lidar_parity")["rows"]
    coarse = next(
        row for row in benchmark("aimed_parity")["rows"] if (row["table"], row["step_s"]) == ("regulation", 0.02)
    )
    walked = [row for row in benchmark("roadmap_paths")["episodes"] if row["policy"] == "road map"]
    pymunk = benchmark("billiards_speed")["times_pymunk"]["playing"]["simulate_many"]
    shots = max(row["shots_a_second"] for row in benchmark("billiards_shots_h200")["rows"])
    jaxnav = next(row for row in benchmark("navigation_speed")["rows"] if (row["envs"], row["system"]) == (256, "ours"))
    devices = benchmark("device_scaling")["rows"]
    same, equal = min(row["same_pocketed"] for row in parity), min(row["equal"] for row in beams)
    success = min(row["success"] for row in walked)
    gain = devices[-1]["steps_per_second"] / devices[0]["steps_per_second"]
    there = f"{coarse['reward_in_chipmunk']:.2f} (here {coarse['reward']:.2f})"
    return [
        [
            "Shots that pocket the same balls as Chipmunk at 0.2 ms",
            f"{100 * same:.0f}% or more",
            "98%",
            MORE["engines"],
        ],
        ["Reward of an aimed shot in Chipmunk at the public code's 20 ms", there, "", MORE["engines"]],
        ["Lidar beams within 1 mm of MuJoCo's rays", f"{100 * equal:.0f}%", "99.9%", MORE["engines"]],
        ["Success of the road-map teacher", f"{100 * success:.1f}% or more", "", MORE["engines"]],
        ["Billiards shots a second over pymunk's, 2 cores", f"{pymunk:.0f} times", "20 times", MORE["speed"]],
        ["Billiards shots a second, one H200", f"{shots / 1e6:.0f} million", "10 million", MORE["speed"]],
        [
            "Navigation steps a second over JaxNav's, 2 cores",
            f"{jaxnav['times_jaxnav']:.0f} times",
            "8 times",
            MORE["speed"],
        ],
        ["Training on four H200s over one", f"{gain:.2f} times", "3.6 times", MORE["speed"]],
    ]


# --- the page --------------------------------------------------------------------------------------------------------

TASKS = {
    "billiards": (billiards, draw_billiards, "learning billiards with labels and without"),
    "navigation": (navigation, draw_navigation, "success in navigation over steps"),
    "arms": (arms, draw_arms, "success of arms with a displaced camera"),
    "quadruped": (quadruped, draw_quadruped, "success of an agent on the quadruped"),
}
OTHER_HEADERS = {
    "adaptation": ["scenario", "adapted", "not adapted", "more"],
    "quadruped": ["finding", "on legs", "simple robot", "more"],
    "simulators": ["measured", "here", "asked for", "more"],
}


def sections(page: Path) -> dict[str, str]:
    """Return the sections of the page; their figures are there."""
    found = {}
    for task, (rows, _, alt) in TASKS.items():
        table = markdown(OTHER_HEADERS.get(task, HEADER), rows())
        found[task] = f"{image(alt, FIGURES / f'results_{task}', page)}\n\n{table}"
    picture = image("every scenario before and after 250 labels", DATA / "adaptation" / "overview", page)
    found["adaptation"] = f"{picture}\n\n{markdown(OTHER_HEADERS['adaptation'], adapted())}"
    found["simulators"] = markdown(OTHER_HEADERS["simulators"], simulators())
    return found


def main() -> int:
    """Write the figures and the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, default=DOCS / "results.md")
    given = parser.parse_args()
    for task, (_, draw, _) in TASKS.items():
        draw(FIGURES / f"results_{task}")
    draw_engines(FIGURES / "results_engines")
    given.page.write_text(rendered(given.page.read_text(encoding="utf-8"), sections(given.page)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
