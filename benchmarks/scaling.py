"""Growth of cost with seeds, labels, directions and the width of the networks, on any machine.

    python benchmarks/scaling.py --out scaling.json                                    # minutes on 2 cores
    python benchmarks/scaling.py --preset paper --seeds 1 8 64 256 --out scaling.json  # an accelerator
    python benchmarks/scaling.py --draw scaling.json --figure docs/figures/scaling

One thing is varied at a time, from the preset's own sizes with `--base-seeds` seeds. Training is unguided, from the
first step on; labels are measured by rounds of questions with their fit, and by the fit alone. Replay is cut to 100,000
steps a seed, which changes memory alone. Every point is written when it is measured: the same command goes on where it
was stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from _measuring import Labelled, learning, measure
from matplotlib import ticker
from matplotlib.figure import Figure

from cuelearner_jax.report.figures import OTHER_COLOURS, STYLE, save_figure
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.storage.whole import replacing
from cuelearner_jax.task import Task
from cuelearner_jax.tasks import registry

REPLAY = 100_000
ROUNDS = 3  # of labels, after the one that compiles
DECADE = 10.0  # no panel shows less, lest a flat line look steep
AXES = {
    "seeds": ("seeds at once", "ms_a_step", "ms a step of all seeds"),
    "directions": ("directions", "ms_a_step", "ms a step of all seeds"),
    "width": ("width of the first layer", "ms_a_step", "ms a step of all seeds"),
    "labels": ("labels", "all_rounds_s", "seconds for all rounds"),
}


def main() -> int:
    """Measure what is missing, prints a table, or draws."""
    asked = _arguments()
    if asked.draw:
        save_figure(_draw([json.loads(path.read_text()) for path in asked.draw]), asked.figure)
        print(f"wrote {asked.figure}.png and .svg")
        return 0
    preset = registry.find(asked.task).presets[asked.preset]
    setting = {"task": asked.task, "preset": asked.preset, "base_seeds": asked.base_seeds, "replay": REPLAY}
    contents = {**setting, **provenance(), "rows": []}
    if asked.out.exists():
        contents = json.loads(asked.out.read_text())
        if {name: contents.get(name) for name in setting} != setting:
            raise SystemExit(f"{asked.out} holds measurements of another setting: give another --out")
    agent = dataclasses.replace(preset.config.agent, replay_capacity=min(REPLAY, preset.config.agent.replay_capacity))
    task, config = registry.find(asked.task), dataclasses.replace(preset.config, agent=agent)
    for axis, value in _points(asked, contents["rows"]):
        print(f"{axis} {value} ...", flush=True)
        figures = (
            _labels(task, config, asked.base_seeds, value)
            if axis == "labels"
            else _training(task, config, asked, axis, value)
        )
        contents["rows"].append({"axis": axis, "value": value, **figures})
        with replacing(asked.out) as file:  # in one step: a killed call leaves the points before
            file.write(json.dumps(contents, indent=1) + "\n")
    _print(contents["rows"])
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=sorted(registry.names()), default="billiards")
    parser.add_argument("--preset", default="quickstart")
    parser.add_argument("--base-seeds", type=int, default=8, help="while something else is varied")
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 4, 8, 16])
    parser.add_argument("--labels", type=int, nargs="*", default=[100, 500, 2000])
    parser.add_argument("--directions", type=int, nargs="*", default=[360, 1800, 3600])
    parser.add_argument(
        "--widths", type=int, nargs="*", default=[64, 128, 256], help="of the first layer; others scale"
    )
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement of training")
    parser.add_argument("--out", type=Path, default=Path("scaling.json"))
    parser.add_argument("--draw", type=Path, nargs="+", help="draw these files instead of measuring")
    parser.add_argument("--figure", type=Path, default=Path("scaling"), help="name of the figure without its ending")
    asked = parser.parse_args()
    if asked.preset not in registry.find(asked.task).presets:
        parser.error(f"--preset: choose one of {', '.join(registry.find(asked.task).presets)}")
    return asked


def _points(asked: argparse.Namespace, rows: Sequence[dict[str, Any]]) -> list[tuple[str, int]]:
    """Return the points still to be measured."""
    grid = {"seeds": asked.seeds, "directions": asked.directions, "width": asked.widths, "labels": asked.labels}
    measured = {(row["axis"], row["value"]) for row in rows}
    return [(axis, value) for axis, values in grid.items() for value in values if (axis, value) not in measured]


def _training(task: Task, config: RunConfig, asked: argparse.Namespace, axis: str, value: int) -> dict[str, Any]:
    """Figures of training with one thing changed."""
    agent, seeds = config.agent, asked.base_seeds
    if axis == "seeds":
        seeds = value
    elif axis == "directions":
        agent = dataclasses.replace(agent, directions=value)
    else:
        layers = tuple(max(1, width * value // agent.q_layers[0]) for width in agent.q_layers)
        agent = dataclasses.replace(agent, q_layers=layers)
    config = dataclasses.replace(config, agent=agent)
    return measure(lambda: task.environment(config.task), config, seeds, asked.seconds)


def _labels(task: Task, config: RunConfig, seeds: int, budget: int) -> dict[str, Any]:
    """Seconds of a round of questions with its fit, of the fit alone, and of all rounds of a budget."""
    env = task.environment(config.task)
    teacher = task.make_teacher(config.task, env)
    began = time.perf_counter()
    timed = Labelled(learning(config), env, "relative", seeds, budget)
    timed.label_round(teacher)
    first = time.perf_counter() - began
    round_s = statistics.median(timed.label_round(teacher) for _ in range(ROUNDS))
    timed.fit()  # compiles
    return {
        "seeds": seeds,
        "round_s": round_s,
        "fit_s": statistics.median(timed.fit() for _ in range(ROUNDS)),
        "all_rounds_s": round_s * timed.group.rounds,
        "first_round_s": first,
    }


def _print(rows: Sequence[dict[str, Any]]) -> None:
    """Markdown tables, as docs/scaling.md holds them."""
    print("| varied | value | seeds | ms a step | steps a second, all seeds | MB a seed | first step [s] |")
    print("|---|---|---|---|---|---|---|")
    for row in (row for row in rows if row["axis"] != "labels"):
        print(
            f"| {row['axis']} | {row['value']:,} | {row['seeds']} | {row['ms_a_step']:.3f} | "
            f"{row['steps_a_second']:,.0f} | {row['mb_a_seed']:.2f} | {row['first_step_s']:.1f} |"
        )
    print("\n| labels | seeds | a round with its fit [s] | the fit alone [s] | all rounds [s] |\n|---|---|---|---|---|")
    for row in (row for row in rows if row["axis"] == "labels"):
        print(
            f"| {row['value']:,} | {row['seeds']} | {row['round_s']:.3f} | {row['fit_s']:.3f} | "
            f"{row['all_rounds_s']:.1f} |"
        )


def _draw(measured: Sequence[dict[str, Any]]) -> Figure:
    """Draw one panel for each varied quantity, one line a machine; slope 1 is proportional growth."""
    with matplotlib.rc_context(STYLE):
        counts = Counter(row["axis"] for contents in measured for row in contents["rows"])
        drawn = {axis: about for axis, about in AXES.items() if counts[axis] > 1}
        figure = Figure(figsize=(2.5 * len(drawn), 3), layout="constrained")
        panels = figure.subplots(1, len(drawn), squeeze=False)[0]
        for axes, (axis, (label, name, unit)) in zip(panels, drawn.items(), strict=True):
            for contents, colour in zip(measured, list(OTHER_COLOURS) * len(measured), strict=False):
                points = sorted((row["value"], row[name]) for row in contents["rows"] if row["axis"] == axis)
                machine = f"{contents['hardware']}, {contents['preset']}"
                axes.plot(*zip(*points, strict=True), "o-", color=colour, label=machine, linewidth=1.5, markersize=4)
            axes.set(xscale="log", yscale="log", xlabel=label)
            low, high = axes.get_ylim()
            wider = max(1.0, (DECADE / (high / low)) ** 0.5)
            axes.set_ylim(low / wider, high * wider)
            values = sorted({row["value"] for contents in measured for row in contents["rows"] if row["axis"] == axis})
            axes.set_xticks(values, [f"{value:,}" for value in values], rotation=45)
            axes.xaxis.set_minor_locator(ticker.NullLocator())
            axes.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            axes.yaxis.set_minor_locator(ticker.NullLocator())
            axes.set_title(unit, fontsize=9)
        handles, names = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(names))
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
