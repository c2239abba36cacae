"""Label efficiency in navigation: every form of feedback, with budgets, faulty teachers and pacing.

    python experiments/navigation_bootstrapping.py --list
    python experiments/navigation_bootstrapping.py --out FOLDER --pieces clutter/frame [--resume]
    python experiments/navigation_bootstrapping.py --out FOLDER --report

The sweeps are data below: every piece has a folder of its own and is resumed. After the pieces, or alone with --report,
there is a report of each world (FOLDER/clutter/report). At the scale `smoke` a piece takes seconds. Collisions:
`cuelearner report FOLDER/long/raw --metric collision --lower-is-better --out COLLISIONS`.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from _pieces import SMOKE, Experiment, Options, Piece, Scale, run

BUDGETS = (25, 50, 100, 350, 500, 1_000)
ASKING = ("relative", "demonstration", "scalar", "dcoach")

HALLS: Options = {
    "preset": "paper",
    "schedule.total-steps": 100_000,
    "schedule.guidance-until": 100_000,
    "schedule.eval-every": 10_000,
    "schedule.eval-envs": 200,
    "schedule.eval-steps": 40_000,
    "schedule.checkpoint-every": 50_000,
    "sizes.frame": "action",
    "arbiter": "episodes",
}
# The figure of docs/results.md; `shipped:navigation` is its seed 1000 with 500 labels.
LONG: Options = {**HALLS, "schedule.total-steps": 150_000, "first-seed": 1000, "sizes.frame": "raw"}
# Given on the labelling page by a script that sees the page alone, and errs (docs/labels.md).
PAGE = Path(__file__).parents[1] / "docs/data/labelling/navigation/labels.parquet"
VARIATIONS: dict[str, Options] = {  # of 500 relative labels
    "flipped-20": {"scalars.mistake-probability": 0.2},
    "random": {"scalars.mistake-probability": 0.5},  # leaves "already right" true, which `shuffled` does not
    "shuffled": {"scalars.answer": "shuffled"},
    "silent-20": {"scalars.silence-probability": 0.2},
    "biased": {"scalars.teacher-bias-deg": 10.0},
    "active": {"sizes.ensemble": 5, "sizes.candidates": 16},
    "paced": {"arbiter": "paced", "arbiter.lead": 10.0},  # a return: the lead of guided episodes for a whole share
    "page": {"labels-from": PAGE},
    "raw": {"sizes.frame": "raw"},
}
PIECES = (
    Piece("clutter", "frame", "none", ("none",), (), 16, HALLS),
    Piece("clutter", "frame", "heuristic", ("heuristic",), (), 16, HALLS),
    *(Piece("clutter", "frame", kind, (kind,), BUDGETS, 16, HALLS) for kind in ASKING),
    Piece("clutter", "raw", "none", ("none",), (), 8, {**HALLS, **VARIATIONS["raw"]}),
    *(
        Piece("clutter", run_name, "relative", ("relative",), (500,), 8, {**HALLS, **options})
        for run_name, options in VARIATIONS.items()
    ),
    *(Piece("long", "raw", kind, (kind,), (), 16, LONG) for kind in ("none", "heuristic")),
    *(Piece("long", "raw", f"relative-{count}", ("relative",), (count,), 16, LONG) for count in (100, 350, 500)),
)

SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        seeds=2,
        labels={25: 5, 350: 10, 500: 15},
        options={
            **SMOKE,
            "task.worlds": 2,
            "task.max-steps": 20,
            "agent.q-layers": 16,
            "agent.directions": 12,
            "agent.target-directions": 6,
            "agent.n-step": 3,
        },
    ),
    "paper": Scale("half an hour a piece on an accelerator"),
}

EXPERIMENT = Experiment(
    "navigation",
    PIECES,
    SCALES,
    report={"clutter": ("--level", "0.9", "--reference", "relative"), "long": ("--level", "0.9")},
    metric=("--metric", "success"),
)
main = partial(run, EXPERIMENT, __doc__ or "")


if __name__ == "__main__":
    raise SystemExit(main())
