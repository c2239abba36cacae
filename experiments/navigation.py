"""Success and collisions of navigation under each form of guidance, as in the paper's figure (25 minutes on a GPU).

    python experiments/navigation.py --out FOLDER [--pieces relative-350 relative-500] [--dtype bfloat16] [--resume]

Sixteen seeds that no setting was chosen on, 150,000 steps each, labels by the road-map teacher; validation in worlds of
their own. Then 2,000 validation episodes of every agent, 500 in each of two styles of worlds that it never saw, and the
curves. A piece is one kind of guidance with one budget; with several devices, give each process its pieces and device
(CUDA_VISIBLE_DEVICES) and the same FOLDER. With --resume interrupted pieces go on, finished ones are left as they are.
Options that are not listed here are given to the sweeps (all of them: cuelearner sweep navigation --help).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from cuelearner_jax.cli import main as cuelearner

PIECES = {
    "relative-500": ("relative", "500"),
    "relative-350": ("relative", "350"),
    "relative-100": ("relative", "100"),
    "none": ("none", "100"),
    "heuristic": ("heuristic", "100"),
}
SWEEP = {
    "--seeds": "16",
    "--first-seed": "1000",
    "--schedule.total-steps": "150000",
    "--schedule.guidance-until": "100000",
    "--schedule.eval-every": "10000",
    "--schedule.eval-envs": "200",
    "--schedule.eval-steps": "40000",
    "--schedule.checkpoint-every": "50000",
}
LONGEST = 200  # steps of an episode
EVALUATIONS = {  # name: policy, style, episodes
    "agent": ("agent", "clutter", 2000),
    "guide": ("guide", "clutter", 500),
    "agent-rooms": ("agent", "rooms", 500),
    "agent-corridor": ("agent", "corridor", 500),
}


def commands(out: Path, piece: str, resume: bool, extra: list[str]) -> list[list[str]]:
    """The command lines of one piece, in their order."""
    run = out / piece
    guidance, labels = PIECES[piece]
    options = [text for pair in {"--guidance": guidance, "--labels": labels, **SWEEP}.items() for text in pair]
    going_on = ["--resume"] if resume and (run / "config.json").exists() else []
    made = [["sweep", "navigation", "--preset", "paper", *options, "--out", str(run), *extra, *going_on]]
    for name, (policy, style, episodes) in EVALUATIONS.items():
        measured = out / "evaluations" / f"{piece}-{name}.json"
        if not measured.exists() and (policy == "agent" or guidance != "none"):
            asked = ["--policy", policy, "--envs", str(episodes), "--steps", str(episodes * LONGEST)]
            made.append(["evaluate", str(run), *asked, "--task.style", style, "--out", str(measured)])
    return made


def main() -> int:
    """Run the commands; stops at the first that fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--out", type=Path, default=Path("runs/navigation"))
    parser.add_argument("--pieces", nargs="+", choices=PIECES, default=list(PIECES), help="these alone")
    parser.add_argument("--resume", action="store_true", help="go on with pieces that were begun, leave finished ones")
    arguments, extra = parser.parse_known_args()
    how = arguments.resume, extra
    asked = [line for piece in arguments.pieces for line in commands(arguments.out, piece, *how)]
    if arguments.pieces == list(PIECES):
        runs = [str(arguments.out / piece) for piece in PIECES]
        for metric, sense in (("success", []), ("collision", ["--lower-is-better"])):
            folder = str(arguments.out / metric)
            asked.append(["report", *runs, "--metric", metric, *sense, "--out", folder, "--overwrite"])
    return next((status for command in asked if (status := cuelearner(command))), 0)


if __name__ == "__main__":
    raise SystemExit(main())
