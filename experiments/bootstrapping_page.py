"""Writes the tables of docs/results/bootstrapping.md from recorded runs, and nothing else of it.

    python experiments/bootstrapping_page.py --data docs/data/bootstrapping --page docs/results/bootstrapping.md

For every table or hall of which there are runs in the data (WORLD/RUN/PIECE, as the two experiments of that name leave
them) the command `cuelearner report --efficiency` writes WORLD/report, and its section on label efficiency goes between
the lines `<!-- WORLD -->` and `<!-- end of WORLD -->` of the page, in place of what was there.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Mapping
from pathlib import Path

import billiards_bootstrapping
import navigation_bootstrapping
from _pieces import report_command

from cuelearner_jax.cli import main as cuelearner

EXPERIMENTS = (billiards_bootstrapping.EXPERIMENT, navigation_bootstrapping.EXPERIMENT)
FIRST, LAST = "## Label efficiency\n", "## Where the numbers come from"


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
    """Reports on every world and writes the page; returns the status of the first command that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("docs/data/bootstrapping"))
    parser.add_argument("--page", type=Path, default=Path("docs/results/bootstrapping.md"))
    asked = parser.parse_args()
    sections = {}
    for experiment in EXPERIMENTS:
        for world in dict.fromkeys(piece.world for piece in experiment.pieces):
            command = report_command(experiment, world, asked.data, "paper")
            if command is None or "--efficiency" not in command:
                print(f"{world}: no runs in {asked.data}, or no unguided ones")
                continue
            if status := cuelearner(command):
                return status
            folder = asked.data / world / "report"
            seen = Path(os.path.relpath(folder, asked.page.parent)).as_posix()
            sections[world] = section((folder / "report.md").read_text(encoding="utf-8"), seen)
    asked.page.write_text(rendered(asked.page.read_text(encoding="utf-8"), sections), encoding="utf-8")
    print(f"wrote {asked.page}: {', '.join(sections) or 'nothing new'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
