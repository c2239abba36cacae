"""Measure the effect of a guide with and without pacing. One ball; minutes on 2 cores.

    python experiments/pace.py --out FOLDER

The preset `quickstart` of the task `billiards` on tuning episodes and seeds, unguided and under four guides: 100
relative labels, 100 labels of which every turn is told the wrong way round half of the time ("already right" stays
true), 100 labels that have each other's answers, and the closest ball. Each guides a fixed half of the episodes, paced
by any lead, and paced by the preset's lead. Prints the mean over the learning curve, its difference from the same seeds
unguided, and the share of guided steps. Options that are not listed here are given to every sweep, for instance
--schedule.total-steps 6000. Called again, it goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from cuelearner_jax.cli import main as cuelearner
from cuelearner_jax.report.statistics import interval
from cuelearner_jax.storage import results

GUIDES = {
    "relative, 100 labels": ["--guidance", "relative"],
    "relative, answers at random": ["--guidance", "relative", "--scalars.mistake-probability", "0.5"],
    "relative, shuffled answers": ["--guidance", "relative", "--scalars.answer", "shuffled"],
    "heuristic": ["--guidance", "heuristic"],
}
HOW = {
    "half": ["--arbiter", "episodes"],
    "paced, any lead": ["--arbiter", "paced", "--arbiter.lead", "0"],
    "paced": ["--arbiter", "paced"],
}
VARIANTS = {
    "none": ["--guidance", "none"],
    **{f"{guide}, {how}": [*options, *how_options] for guide, options in GUIDES.items()
       for how, how_options in HOW.items()},
}  # fmt: skip


def read_values(folder: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean over the curve (seeds,) and last reward (seeds,), by seed; share of guided steps while there is guidance."""
    rows = sorted(results.read(folder).to_pylist(), key=lambda row: (row["seed"], row["step"]))
    seeds = sorted({row["seed"] for row in rows})
    curves = np.array([row["reward"] for row in rows if row["step"]]).reshape(len(seeds), -1)
    shares = [row["train_guided_share"] for row in rows if row.get("train_guided_share")]
    return curves.mean(1), curves[:, -1], float(np.mean(shares)) if shares else np.nan


def format_values(values: np.ndarray) -> str:
    """A mean over seeds with its interval."""
    rng = np.random.default_rng(0)
    means = rng.choice(values, (2000, len(values))).mean(1)
    low, high = np.percentile(means, [2.5, 97.5])
    return f"{values.mean():+.3f} [{low:+.3f}, {high:+.3f}]"


def main() -> int:
    """Run the sweeps and prints a table; stops at the first that fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--out", type=Path, default=Path("runs/pace"), help="folder (default: %(default)s)")
    asked, rest = parser.parse_known_args()
    common = ["sweep", "billiards", "--preset", "quickstart", "--tuning", "--first-seed", "0", *rest]
    found = {}
    for name, options in VARIANTS.items():
        out = asked.out / name.replace(", ", "-").replace(" ", "_")
        resume = ["--resume"] if (out / "config.json").exists() else []
        status = cuelearner([*common, *options, "--out", str(out), *resume])
        if status:
            return status
        found[name] = read_values(out)
    unguided = found["none"]
    print(f"{'':36}  IQM over the curve      mean - unguided's          last - unguided's          guided")
    for name, (mean, last, share) in found.items():
        middle = interval(mean)
        own = f"{middle.estimate:.3f} [{middle.lower:.3f}, {middle.upper:.3f}]"
        print(
            f"{name:36}  {own}  {format_values(mean - unguided[0])}  {format_values(last - unguided[1])}  {share:.3f}"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
