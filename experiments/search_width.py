"""Whether an agent learns less when its argmax looks roughly first: the same seeds under three searches.

    python experiments/search_width.py --out FOLDER [--steps 1000000] [--late 2000000] [--seeds 8]

The preset `regulation`, unguided, whose networks see from the strike. While learning, agents look at 360 directions and
then near four peaks; at 720 and near eight; or at all 3,600. Every evaluation looks at all. Prints the reward after
`--steps`, and the difference from the full search, paired by seed. The roughest search goes on to `--late` steps, for
`benchmarks/search_agreement.py` to measure late agents. The sweeps run side by side on one accelerator, each with its
share of the memory, and may be resumed by the same command: half an hour on one H200. Options that are not listed here
are given to every sweep.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from cuelearner_jax.records import results
from cuelearner_jax.report.statistics import interval

SEARCHES = {
    "all 3,600": {"coarse-directions": 0},
    "720, 8 peaks": {"coarse-directions": 720, "peaks": 8},
    "360, 4 peaks": {"coarse-directions": 360, "peaks": 4},
}
FULL, ROUGHEST = "all 3,600", "360, 4 peaks"


def folder(out: Path, search: str) -> Path:
    """Where the sweep of a search lies."""
    return out / search.replace(",", "").replace(" ", "-")


def begin(out: Path, search: str, steps: int, seeds: int, rest: list[str]) -> subprocess.Popen:
    """Starts or resumes a sweep in a process of its own, whose output goes to a file beside its folder."""
    own = folder(out, search)
    options = [part for name, value in SEARCHES[search].items() for part in (f"--sizes.{name}", str(value))]
    command = [sys.executable, "-m", "cuelearner_jax.cli", "sweep", "billiards", "--preset", "regulation"]
    command += ["--guidance", "none", "--seeds", str(seeds), "--schedule.total-steps", str(steps), *options, *rest]
    command += ["--out", str(own), *(["--resume"] if (own / "config.json").exists() else [])]
    environment = {**os.environ, "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / len(SEARCHES):.2f}"}
    out.mkdir(parents=True, exist_ok=True)
    with own.with_suffix(".log").open("a") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, env=environment)


def rewards(run: Path, step: int) -> np.ndarray:
    """Validation reward a shot (seeds,) at a step, by seed."""
    rows = [row for row in results.read(run).to_pylist() if row["step"] == step]
    return np.array([row["reward"] for row in sorted(rows, key=lambda row: row["seed"])])


def told(values: np.ndarray) -> str:
    """An interquartile mean with its interval."""
    found = interval(values)
    return f"{found.estimate:.3f} [{found.lower:.3f}, {found.upper:.3f}]"


def main() -> int:
    """Runs the sweeps and prints a table; returns 1 if one fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--out", type=Path, default=Path("runs/search"), help="folder (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=1_000_000, help="at which agents are compared")
    parser.add_argument("--late", type=int, default=2_000_000, help="to which the roughest search goes on")
    parser.add_argument("--seeds", type=int, default=8)
    asked, rest = parser.parse_known_args()
    begun = {
        search: begin(asked.out, search, asked.late if search == ROUGHEST else asked.steps, asked.seeds, rest)
        for search in SEARCHES
    }
    if failed := [search for search, process in begun.items() if process.wait()]:
        print(f"failed: {', '.join(failed)}; see the .log files in {asked.out}", file=sys.stderr)
        return 1
    found = {search: rewards(folder(asked.out, search), asked.steps) for search in SEARCHES}
    print(f"{'search while learning':24}  reward at {asked.steps:,} steps    lost against {FULL}")
    for search, values in found.items():
        print(f"{search:24}  {told(values)}    {told(found[FULL] - values)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
