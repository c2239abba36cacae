"""Whether an agent learns less when its argmax looks roughly first: the same seeds under three searches.

    python experiments/search_width.py --out FOLDER [--steps 1000000] [--seeds 8]

The preset `regulation`, unguided, whose networks see from the strike. While learning, agents look at 360 directions and
then near four peaks; at 720 and near eight; or at all 3,600. Every evaluation looks at all. Prints, at each quarter of
`--steps` that all searches have reached, the reward and the difference from the full search, paired by seed, and writes
them to FOLDER/search_width.json. `benchmarks/search_agreement.py` then measures the late agents in FOLDER.

The sweeps run side by side on one accelerator, each with its share of the memory: 25 minutes on one H200, of which the
full search takes longest. The same command goes on after an interruption; `--table` only reads what is there. Options
that are not listed here are given to every sweep.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from cuelearner_jax.report.statistics import interval
from cuelearner_jax.storage import results

SEARCHES = {
    "all 3,600": {"coarse-directions": 0},
    "720, 8 peaks": {"coarse-directions": 720, "peaks": 8},
    "360, 4 peaks": {"coarse-directions": 360, "peaks": 4},
}
FULL = "all 3,600"


def folder(out: Path, search: str) -> Path:
    """Return the folder of a search's sweep."""
    return out / search.replace(",", "").replace(" ", "-")


def begin(out: Path, search: str, steps: int, seeds: int, rest: list[str]) -> subprocess.Popen:
    """Start or resumes a sweep in a process of its own, whose output goes to a file beside its folder."""
    own = folder(out, search)
    options = [part for name, value in SEARCHES[search].items() for part in (f"--sizes.{name}", str(value))]
    command = [sys.executable, "-m", "cuelearner_jax.cli", "sweep", "billiards", "--preset", "regulation"]
    command += ["--guidance", "none", "--seeds", str(seeds), "--schedule.total-steps", str(steps), *options, *rest]
    command += ["--out", str(own), *(["--resume"] if (own / "config.json").exists() else [])]
    environment = {**os.environ, "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / len(SEARCHES):.2f}"}
    out.mkdir(parents=True, exist_ok=True)
    with own.with_suffix(".log").open("a") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, env=environment)


def curves(run: Path) -> dict[int, np.ndarray]:
    """Validation reward a shot (seeds,), by seed, at each step that all seeds have reached."""
    rows = sorted(results.read(run).to_pylist(), key=lambda row: row["seed"])
    seeds = len({row["seed"] for row in rows})
    found = {step: [row["reward"] for row in rows if row["step"] == step] for step in {row["step"] for row in rows}}
    return {step: np.array(values) for step, values in sorted(found.items()) if len(values) == seeds}


def table(out: Path, steps: int) -> list[dict[str, Any]]:
    """Rewards at each quarter of the steps, of the searches that have got there."""
    found = {search: curves(folder(out, search)) for search in SEARCHES}
    rows = []
    for step in (steps * quarter // 4 for quarter in (1, 2, 3, 4)):
        for search, reached in found.items():
            if step in reached:
                full = found[FULL].get(step)
                against = "" if full is None else format_values(full - reached[step])
                rows.append({"step": step, "search": search, "reward": format_values(reached[step]), "lost": against})
    return rows


def origin(out: Path) -> dict[str, str]:
    """Commit, versions and hardware of the sweeps, as the first one's rows say."""
    row = results.read(folder(out, FULL)).slice(0, 1).to_pylist()[0]
    return {name: row[name] for name in ("commit", "versions", "hardware")}


def format_values(values: np.ndarray) -> str:
    """An interquartile mean with its interval."""
    found = interval(values)
    return f"{found.estimate:.3f} [{found.lower:.3f}, {found.upper:.3f}]"


def main() -> int:
    """Run the sweeps and prints a table; return 1 if one fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--out", type=Path, default=Path("runs/search"), help="folder (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=1_000_000, help="of each seed")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--table", action="store_true", help="run nothing")
    asked, rest = parser.parse_known_args()
    searches = () if asked.table else SEARCHES
    begun = {search: begin(asked.out, search, asked.steps, asked.seeds, rest) for search in searches}
    if failed := [search for search, process in begun.items() if process.wait()]:
        print(f"failed: {', '.join(failed)}; see the .log files in {asked.out}", file=sys.stderr)
        return 1
    rows = table(asked.out, asked.steps)
    print(f"{'steps':>9}  {'search while learning':22}  {'reward':22}  lost against the full search")
    for row in rows:
        print(f"{row['step']:9,}  {row['search']:22}  {row['reward']:22}  {row['lost']}")
    (asked.out / "search_width.json").write_text(json.dumps({**origin(asked.out), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
