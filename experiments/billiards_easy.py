"""Measure whether guidance speeds up learning on the easy table (three balls). Minutes a variant on one GPU.

    python experiments/billiards_easy.py --out FOLDER [plain|mirrors ...]

The sweeps of docs/results/training.md as data: eight seeds, 200,000 steps, labels by the shipped teacher. `plain` has
the paper's strength of a label. `mirrors` differs from it in mirrored transitions alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from cuelearner_jax.cli import main as cuelearner

SCHEDULE = {
    "total-steps": 200_000,
    "guidance-until": 100_000,
    "eval-every": 10_000,
    "eval-steps": 5_000,
    "checkpoint-every": 100_000,
}
# As recorded, whatever the preset has become: raw coordinates, all directions searched.
RAW = ["--sizes.frame", "raw", "--agent.directions", "720", "--agent.coarse-directions", "0"]
LABELS = ["--guidance", "none", "relative", "heuristic", "--labels", "500", "1000"]
VARIANTS = {"plain": [*RAW, *LABELS], "mirrors": [*RAW, *LABELS, "--task.mirrors"]}


def main() -> int:
    """Run and reports each variant; stops at the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variants", nargs="*", help=f"of {', '.join(VARIANTS)} (default: all)")
    parser.add_argument("--out", type=Path, default=Path("runs/billiards_easy"))
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted run")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.variants if name not in VARIANTS]
    if unknown:
        parser.error(f"unknown variant {unknown[0]!r}: choose among {', '.join(VARIANTS)}")
    for name in arguments.variants or VARIANTS:
        out = arguments.out / name
        schedule = [part for key, value in SCHEDULE.items() for part in (f"--schedule.{key}", str(value))]
        sweep = [
            "sweep",
            "billiards",
            "--preset",
            "easy",
            "--seeds",
            "8",
            "--arbiter episodes",  # as what docs/results/training.md tells was made
            *VARIANTS[name],
            *schedule,
            "--out",
            str(out),
        ]
        resume = ["--resume"] if arguments.resume and (out / "config.json").exists() else []
        status = cuelearner([*sweep, *resume]) or cuelearner(
            ["report", str(out), "--out", str(out / "report"), "--overwrite"]
        )
        if status:
            return status
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
