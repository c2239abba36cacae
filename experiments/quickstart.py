"""The quickstart: unguided and guided agents on one-ball billiards, then curves, a table and a film. About two minutes.

    python experiments/quickstart.py --out FOLDER

The sweep is the preset `quickstart` of the task `billiards`. It runs the same commands that a user would type, and says
where guided agents did better than unguided ones by more than chance. Options that are not listed here are given to the
sweep, for instance --seeds 4 (all of them: cuelearner sweep billiards --help).
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

from cuelearner_jax.cli import main as cuelearner

FILM = "relative"


def main() -> int:
    """Run the commands in turn; stops at the first that fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--out", type=Path, default=Path("runs/quickstart"), help="folder (default: %(default)s)")
    asked, rest = parser.parse_known_args()
    out, started = asked.out, time.perf_counter()
    commands = [
        ["sweep", "billiards", "--preset", "quickstart", "--out", str(out), *rest],
        ["report", str(out), "--out", str(out / "report"), "--overwrite"],
        ["render", str(out), "--guidance", FILM, "--out", str(out / "pictures"), "--overwrite"],
    ]
    for command in commands:
        print(f"\n$ cuelearner {' '.join(command)}", flush=True)
        status = cuelearner(command)
        if status:
            return status
    print(f"\nafter {time.perf_counter() - started:.0f} s:")
    with (out / "report" / "summary.csv").open() as file:
        for row in csv.DictReader(file):
            if row["guidance"] != "none":
                where = ", ".join(_span(stretch) for stretch in row["above_unguided"].split("; ")) or "nowhere"
                print(f"  {row['guidance']}, {row['labels']} labels: above unguided, intervals apart, at steps {where}")
    print(f"  curves and table: {out / 'report'} (report.md, curves.png)\n  a film of the agent: {out / 'pictures'}")
    return 0


def _span(stretch: str) -> str:
    """`300-1800` as words; a stretch of one evaluation as its step."""
    first, _, last = stretch.partition("-")
    return first if first == last else f"{first} to {last}"


if __name__ == "__main__":
    raise SystemExit(main())
