"""Success and collisions of navigation under each form of guidance, as in the paper's figure (20 minutes on a GPU).

    python experiments/navigation.py --out FOLDER [--dtype bfloat16]

Sixteen seeds that no setting was chosen on, 200,000 steps each, labels by the road-map teacher; validation in worlds of
their own. Then 2,000 validation episodes of every agent. The sweep is resumed if it was interrupted.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from cuelearner_jax.cli import main as cuelearner

SWEEP = {
    "--seeds": ("16",),
    "--first-seed": ("1000",),
    "--guidance": ("relative", "none", "heuristic"),
    "--labels": ("100", "350", "500"),
    "--schedule.total-steps": ("200000",),
    "--schedule.guidance-until": ("100000",),
    "--schedule.eval-every": ("10000",),
    "--schedule.eval-envs": ("200",),
    "--schedule.eval-steps": ("40000",),
    "--schedule.checkpoint-every": ("50000",),
}
EPISODES, LONGEST = 2000, 200  # of the evaluation at the end; steps of an episode


def commands(out: Path, dtype: str, extra: list[str]) -> list[list[str]]:
    """The command lines that make the figures, in their order."""
    run = out / "run"
    resume = ["--resume"] if (run / "config.json").exists() else []
    sweep = [part for option, values in SWEEP.items() for part in (option, *values)]
    steps = str(EPISODES * LONGEST)
    made = [["sweep", "navigation", *sweep, "--sizes.target-dtype", dtype, "--out", str(run), *extra, *resume]]
    for metric in ("success", "collision"):
        made.append(["report", str(run), "--metric", metric, "--out", str(out / metric), "--overwrite"])
    for policy in ("agent", "guide"):
        measured = out / f"{policy}.json"
        if not measured.exists():
            asked = ["--policy", policy, "--envs", str(EPISODES), "--steps", steps]
            made.append(["evaluate", str(run), *asked, "--out", str(measured)])
    return made


def main() -> int:
    """Runs the commands; stops at the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/navigation"))
    parser.add_argument("--dtype", choices=("float32", "bfloat16"), default="float32", help="of the targets' argmax")
    arguments, extra = parser.parse_known_args()
    for command in commands(arguments.out, arguments.dtype, extra):
        status = cuelearner(command)
        if status:
            return status
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
