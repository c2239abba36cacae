"""Writes the tables of docs/results/bootstrapping.md from recorded runs, and nothing else of it.

    python experiments/bootstrapping_page.py --data docs/data/bootstrapping --page docs/results/bootstrapping.md

For every table or hall of which there are runs in the data (WORLD/RUN/PIECE, as the two experiments of that name leave
them) `label_efficiency.py` writes WORLD/report. Its section on label efficiency goes between the lines `<!-- WORLD -->`
and `<!-- end of WORLD -->` of the page, in place of what was there. Runs at the scale `cpu` (cpu/WORLD/RUN/PIECE) have
places of their own, `<!-- WORLD-cpu -->`.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import billiards_bootstrapping
import navigation_bootstrapping
from _pieces import LABEL_EFFICIENCY, Experiment, folder_at, report_command, reported

EXPERIMENTS = (billiards_bootstrapping.EXPERIMENT, navigation_bootstrapping.EXPERIMENT)
FIRST, LAST = "## Label efficiency\n", "## Where the numbers come from"


class Place(NamedTuple):
    """One world at one scale: what its section of the page comes from."""

    experiment: Experiment
    world: str
    scale: str

    @property
    def mark(self) -> str:
        """The name between the marks of the page."""
        return self.world if self.scale == "paper" else f"{self.world}-{self.scale}"

    def command(self, data: Path) -> list[str] | None:
        """That writes its report, or None where there are no runs of it, or no unguided ones to compare with."""
        command = report_command(self.experiment, self.world, folder_at(data, self.scale), self.scale)
        return command if command and command[0] == LABEL_EFFICIENCY else None

    def report(self, data: Path) -> Path:
        """The folder of its report."""
        return folder_at(data, self.scale) / self.world / "report"


def places() -> Iterator[Place]:
    """Every world at every scale that is reported, in the order of the experiments."""
    for experiment in EXPERIMENTS:
        for scale in (name for name, scale in experiment.scales.items() if scale.reported):
            for world in dict.fromkeys(piece.world for piece in experiment.pieces):
                yield Place(experiment, world, scale)


def section(report: str, folder: str) -> str:
    """What a page shows of a report: its section on label efficiency and what is missing, with links to its figures.

    Args:
        report: the text of report.md.
        folder: of the report, as seen from the page.
    """
    shown = report.split(FIRST)[1].split(LAST, maxsplit=1)[0].replace("## Missing", "Missing:").strip()
    return re.sub(r"(!\[[^]]*\]\()", rf"\1{folder}/", shown)


def rendered(page: str, sections: Mapping[str, str]) -> str:
    """The page with each section between its world's marks.

    Raises:
        ValueError: the page has no such marks.
    """
    for world, text in sections.items():
        first, last = f"<!-- {world} -->\n", f"<!-- end of {world} -->"
        before, mark, rest = page.partition(first)
        _, end, after = rest.partition(last)
        if not mark or not end:
            raise ValueError(f"the page has no place for {world}: give it the lines {first.strip()} and {last}")
        page = f"{before}{first}\n{text}\n\n{last}{after}"
    return page


def main() -> int:
    """Report on every world and writes the page; return the status of the first command that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("docs/data/bootstrapping"))
    parser.add_argument("--page", type=Path, default=Path("docs/results/bootstrapping.md"))
    asked = parser.parse_args()
    sections = {}
    for place in places():
        command = place.command(asked.data)
        if command is None:
            print(f"{place.mark}: no runs in {asked.data}, or no unguided ones")
            continue
        if status := reported(command):
            return status
        folder = place.report(asked.data)
        seen = Path(os.path.relpath(folder, asked.page.parent)).as_posix()
        sections[place.mark] = section((folder / "report.md").read_text(encoding="utf-8"), seen)
    asked.page.write_text(rendered(asked.page.read_text(encoding="utf-8"), sections), encoding="utf-8")
    print(f"wrote {asked.page}: {', '.join(sections) or 'nothing new'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
