"""Write the figure and the table of docs/results/arms.md from recorded data, and nothing else of the page.

    python experiments/arms_page.py [--data docs/data/arms] [--page docs/results/arms.md]

The data are what `cuelearner evaluate --out` wrote of one agent in MJX and in Fetch, and `reach_settings.json`. Two
tables go between the lines `<!-- NAME -->` and `<!-- end of NAME -->` of the page.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib
from _pages import GREY, image, markdown, new_figure, rendered

from cuelearner_jax.report.figures import STYLE, colour_of, save_figure

WORLDS = {
    "reach_mjx": "in MJX",
    "reach_fetch": "in FetchReach, unchanged",
    "reach_fetch_turned": "in FetchReach, camera turned by 10 degrees",
    "reach_fetch_turned_calibrated": "the same world, after 200 labels",
}
STEPS = (3_200, 6_400, 9_600, 12_800)


def measured(data: Path) -> dict[str, tuple[float, float]]:
    """Return success and the distance to the goal [cm] of each recorded evaluation, in the order of `WORLDS`."""
    rows = {name: json.loads((data / f"{name}.json").read_text())["rows"][0] for name in WORLDS}
    return {name: (row["success"][0], 100 * row["distance"][0]) for name, row in rows.items()}


def transfer(found: dict[str, tuple[float, float]]) -> str:
    """Return the table of one agent in MJX and in Fetch."""
    cells = [[WORLDS[name], f"{100 * success:.0f}%", f"{distance:.1f}"] for name, (success, distance) in found.items()]
    return markdown(["an agent of 32,000 steps, trained without labels", "success", "distance to the goal [cm]"], cells)


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


def draw(found: dict[str, tuple[float, float]], stem: Path) -> None:
    """Draw success of the agent in every world, with its distance to the goal."""
    with matplotlib.rc_context(STYLE):
        figure = new_figure(8, 2.4)
        axes = figure.subplots()
        for place, (name, (success, distance)) in enumerate(found.items()):
            colour = colour_of("calibration") if name.endswith("calibrated") else GREY
            axes.barh(place, 100 * success, color=colour)
            told = f"{100 * success:.0f}%, {distance:.1f} cm off"
            axes.text(100 * success + 1.5, place, told, va="center", fontsize=9)
        axes.set_yticks(range(len(found)), [WORLDS[name] for name in found])
        axes.invert_yaxis()
        axes.set(xlim=(0, 150), xlabel="success [%], 200 episodes")
        axes.set_xticks(range(0, 101, 20))
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        save_figure(figure, stem)


def sections(data: Path, page: Path) -> dict[str, str]:
    """Return the sections of the page."""
    picture = image("success of one agent in MJX and in Fetch", data / "transfer", page)
    return {"transfer": f"{picture}\n\n{transfer(measured(data))}", "settings": settings(data)}


def main() -> int:
    """Write the figure and the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("docs/data/arms"))
    parser.add_argument("--page", type=Path, default=Path("docs/results/arms.md"))
    given = parser.parse_args()
    draw(measured(given.data), given.data / "transfer")
    page = rendered(given.page.read_text(encoding="utf-8"), sections(given.data, given.page))
    given.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
