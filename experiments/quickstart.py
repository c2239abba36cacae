"""The quickstart: unguided and guided agents on one-ball billiards, then curves, a table and a film. About two minutes.

    python experiments/quickstart.py [--out FOLDER] [any option of `cuelearner sweep`]

The sweep is the preset `quickstart` of the task `billiards`. It runs the same commands that a user would type, and says
where guided agents did better than unguided ones by more than chance.
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path

from cuelearner_jax.cli import main as cuelearner

FILM = "relative"


def main(arguments: list[str]) -> int:
    """Runs the commands in turn; stops at the first that fails."""
    started = time.perf_counter()
    out, rest = _out(arguments)
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


def _out(arguments: list[str]) -> tuple[Path, list[str]]:
    if "--out" in arguments and arguments.index("--out") + 1 < len(arguments):
        index = arguments.index("--out")
        return Path(arguments[index + 1]), arguments[:index] + arguments[index + 2 :]
    return Path("runs/quickstart"), arguments


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
