"""Write the table and the figure of docs/results/fetch.md from recorded pieces, and nothing else of the page.

    python experiments/fetch_page.py [--data docs/data/fetch] [--page docs/results/fetch.md]

The data are what `fetch_hand_eye.py` leaves in its `--out`. The short table goes between the lines `<!-- fetch -->` and
`<!-- end of fetch -->` of the page; the figure and `success.csv`, the whole table, are written beside the data.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from _pages import GREY, markdown, new_figure, rendered, viewer_link, write_csv

from cuelearner_jax.report.figures import STYLE, colour_of, save_figure

SAYS = {"all": "all cues", "worst": "the worst cue", "one": "one cue at random"}
ASKED = {"all": 90, "worst": 85, "one": 70}  # percent of the loss that are to come back
NAMES = {"calibration": "calibration", "relative": "relative", "offset": "offset"}
DRAWS = 4_000  # of the bootstrap over episodes
Row = dict[str, Any]


class Line(NamedTuple):
    """One row of the table: policies of all label seeds on their own episodes."""

    environment: str
    what: str
    says: str
    shuffled: bool
    seeds: int
    episodes: int
    success: float  # percent
    share: tuple[float, float, float] | None  # of the loss [percent]: estimate, low, high; None: no labels

    @property
    def called(self) -> str:
        """The name of the row."""
        if not self.says:
            return {"unchanged": "camera in its place", "displaced": "camera displaced, no labels"}[self.what]
        told = f"{NAMES[self.what]}, {SAYS[self.says]}"
        return f"{told}, answers shuffled" if self.shuffled else told


def read(folder: Path) -> list[Row]:
    """Return all rows of the recorded pieces, each with its environment."""
    rows = []
    for file in sorted(folder.glob("*/*/*.json")):
        environment = file.parts[-3]
        rows += [{**row, "environment": environment} for row in json.loads(file.read_text())["rows"]]
    return rows


def lines(rows: Sequence[Row]) -> list[Line]:
    """Return the rows of the table. Intervals (95%) draw episodes; each is played by all three policies compared."""
    found = []
    for environment in dict.fromkeys(row["environment"] for row in rows):
        own = [row for row in rows if row["environment"] == environment]
        plain = {what: _by_seed(own, what, "", False) for what in ("unchanged", "displaced")}
        kinds = dict.fromkeys((row["what"], row["says"], row["shuffled"]) for row in own)
        order = ["unchanged", "displaced", *NAMES]
        for what, says, shuffled in sorted(kinds, key=lambda kind: (order.index(kind[0]), kind[2])):
            each = _by_seed(own, what, says, shuffled)
            seeds = sorted(each)
            success = np.concatenate([each[seed] for seed in seeds])
            compared = [np.concatenate([plain[name][seed] for seed in seeds]) for name in plain]
            share = _share(success, *compared) if says else None
            percent = 100 * float(success.mean())
            found.append(Line(environment, what, says, shuffled, len(seeds), len(success), percent, share))
    return found


def _by_seed(rows: Sequence[Row], what: str, says: str, shuffled: bool) -> dict[int, np.ndarray]:
    kind = (what, says, shuffled)
    return {
        row["seed"]: np.array(row["success"], float)
        for row in rows
        if (row["what"], row["says"], row["shuffled"]) == kind
    }


def _share(after: np.ndarray, unchanged: np.ndarray, displaced: np.ndarray) -> tuple[float, float, float]:
    """Return the percent of the loss that come back, with a bootstrap interval over episodes."""
    random = np.random.default_rng(0)
    drawn = random.integers(len(after), size=(DRAWS, len(after)))
    loss, gain = unchanged - displaced, after - displaced
    shares = 100 * gain[drawn].mean(1) / np.maximum(loss[drawn].mean(1), 1e-9)
    low, high = np.percentile(shares, [2.5, 97.5])
    return 100 * float(gain.mean() / loss.mean()), float(low), float(high)


def table(found: Sequence[Line]) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of `success.csv`."""
    header = ["environment", "policy", "label seeds", "episodes", "success [%]", "of the loss [%]", "asked [%]"]
    rows = []
    for line in found:
        wanted = str(ASKED[line.says]) if line.what == "calibration" and not line.shuffled else ""
        seeds = str(line.seeds) if line.says else ""
        rows.append(
            [line.environment, line.called, seeds, str(line.episodes), f"{line.success:.1f}", back(line), wanted]
        )
    return header, rows


def back(line: Line) -> str:
    """Return the share of the loss that comes back, as a cell."""
    return "" if line.share is None else "{:.0f} [{:.0f}, {:.0f}]".format(*line.share)


def short_table(found: Sequence[Line]) -> str:
    """Return the page's table: labels of all cues and of one cue at random, the environments side by side."""
    environments = [*dict.fromkeys(line.environment for line in found)]
    rows: dict[str, dict[str, Line]] = {}
    for line in found:
        if line.says != "worst":
            rows.setdefault(line.called, {})[line.environment] = line
    header = ["100 labels"]
    header += [f"{name.partition('-')[0]}: {what} [%]" for name in environments for what in ("success", "of the loss")]
    cells = []
    for called, own in rows.items():
        pairs = [(f"{own[name].success:.1f}", back(own[name])) if name in own else ("", "") for name in environments]
        cells.append([called, *(cell for pair in pairs for cell in pair)])
    return markdown(header, cells)


def draw(found: Sequence[Line], stem: Path) -> None:
    """Draw success of each row with its number, a panel for each environment; the names stand on the left alone."""
    environments = [*dict.fromkeys(line.environment for line in found)]
    most = max(sum(line.environment == name for line in found) for name in environments)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(10, 0.9 + 0.3 * most)
        panels = figure.subplots(1, len(environments), squeeze=False, sharey=True)[0]
        for axes, name in zip(panels, environments, strict=True):
            own = [line for line in found if line.environment == name]
            colours = [GREY if not line.says or line.shuffled else colour_of(line.what) for line in own]
            axes.barh(range(len(own)), [line.success for line in own], color=colours)
            for place, line in enumerate(own):
                axes.text(line.success + 1.5, place, f"{line.success:.3g}", va="center", fontsize=9)
            axes.set_yticks(range(len(own)), [line.called for line in own])
            axes.set(xlim=(0, 110), xlabel="success [%]")
            axes.set_title(name, fontweight="bold", fontsize=11)
            axes.grid(visible=False, axis="y")
            axes.tick_params(axis="y", length=0)
        panels[0].invert_yaxis()
        save_figure(figure, stem)


def section(found: Sequence[Line], data: Path, page: Path) -> str:
    """Return the page's section: the short table and a link to the whole one."""
    return f"{short_table(found)}\n\nTable: {viewer_link('all rows', data / 'success.csv', page)}."


def main() -> int:
    """Write the page's table and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("docs/data/fetch"))
    parser.add_argument("--page", type=Path, default=Path("docs/results/fetch.md"))
    given = parser.parse_args()
    found = lines(read(given.data))
    if not found:
        parser.error(f"{given.data} holds no pieces: give the --out of fetch_hand_eye.py")
    draw(found, given.data / "success")
    write_csv(given.data / "success.csv", *table(found))
    page = rendered(given.page.read_text(encoding="utf-8"), {"fetch": section(found, given.data, given.page)})
    given.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
