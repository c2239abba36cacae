"""Writes the table and the figure of docs/results/fetch.md from recorded pieces, and nothing else of it.

    python experiments/fetch_page.py --data docs/data/fetch --page docs/results/fetch.md

The data are what `fetch_hand_eye.py` leaves in its `--out`. The table goes between the lines `<!-- fetch -->` and
`<!-- end of fetch -->` of the page, in place of what was there; the figure is written beside the data.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bootstrapping_page import rendered
from matplotlib.figure import Figure

from cuelearner_jax.report.figures import colour_of, save_figure

SAYS = {"all": "all cues", "worst": "the worst cue", "one": "one cue at random"}
ASKED = {"all": 90, "worst": 85, "one": 70}  # percent of the loss that are to come back
NAMES = {"calibration": "calibration", "relative": "relative", "offset": "offset"}
DRAWS = 4_000  # of the bootstrap over episodes
GREY = "#9a9a9a"
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
        """What the row is of."""
        if not self.says:
            return {"unchanged": "camera in its place", "displaced": "camera displaced, no labels"}[self.what]
        told = f"{NAMES[self.what]}, {SAYS[self.says]}"
        return f"{told}, answers shuffled" if self.shuffled else told


def read(folder: Path) -> list[Row]:
    """All rows of the recorded pieces, each with its environment."""
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
    """Percent of the loss that come back, with the ends of a bootstrap interval over episodes."""
    random = np.random.default_rng(0)
    drawn = random.integers(len(after), size=(DRAWS, len(after)))
    loss, gain = unchanged - displaced, after - displaced
    shares = 100 * gain[drawn].mean(1) / np.maximum(loss[drawn].mean(1), 1e-9)
    low, high = np.percentile(shares, [2.5, 97.5])
    return 100 * float(gain.mean() / loss.mean()), float(low), float(high)


def table(found: Sequence[Line]) -> str:
    """The lines in Markdown."""
    rows = ["| environment | policy | label seeds | episodes | success [%] | of the loss [%] | asked [%] |"]
    rows.append("|---|---|---|---|---|---|---|")
    for line in found:
        share = "" if line.share is None else "{:.0f} [{:.0f}, {:.0f}]".format(*line.share)
        wanted = ASKED[line.says] if line.what == "calibration" and not line.shuffled else ""
        seeds = line.seeds if line.says else ""
        own = (line.environment, line.called, seeds, line.episodes, f"{line.success:.1f}", share, wanted)
        rows.append(f"| {' | '.join(map(str, own))} |")
    return "\n".join(rows)


def draw(found: Sequence[Line], stem: Path) -> None:
    """Draw success of each row, a panel for each environment."""
    environments = [*dict.fromkeys(line.environment for line in found)]
    most = max(sum(line.environment == name for line in found) for name in environments)
    figure = Figure(figsize=(9, 0.9 + 0.3 * most), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(environments), squeeze=False)[0], environments, strict=True):
        own = [line for line in found if line.environment == name][::-1]
        colours = [GREY if not line.says or line.shuffled else colour_of(line.what) for line in own]
        axes.barh(range(len(own)), [line.success for line in own], color=colours)
        axes.set_yticks(range(len(own)), [line.called for line in own], fontsize=7)
        axes.set(xlim=(0, 100), xlabel="success [%]", title=name)
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, stem)


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
    page = rendered(given.page.read_text(encoding="utf-8"), {"fetch": table(found)})
    given.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
