"""Label efficiency on the billiards tables: every form of feedback, with budgets, controls and pacing.

    python experiments/billiards_bootstrapping.py --list
    python experiments/billiards_bootstrapping.py --out FOLDER --pieces regulation/frame [--resume]
    python experiments/billiards_bootstrapping.py --out FOLDER --report

The sweeps are data below: every piece has a folder of its own and is resumed. After the pieces, or alone with --report,
there is a report of each table (FOLDER/TABLE/report). At the scale `smoke` a piece takes seconds on a CPU.
"""

from __future__ import annotations

from functools import partial

from _pieces import SMOKE, Experiment, Options, Piece, Scale, run

BUDGETS = (25, 50, 100, 350, 500, 1_000)
ASKING = ("relative", "intent", "demonstration", "scalar", "dcoach")

SCHEDULE: Options = {
    "schedule.total-steps": 1_000_000,
    "schedule.guidance-until": 500_000,
    "schedule.eval-every": 50_000,
    "schedule.checkpoint-every": 250_000,
    "sizes.frame": "action",
    "arbiter": "episodes",
}
TABLES: dict[str, Options] = {
    "regulation": {"preset": "paper", "agent.replay-capacity": 1_000_000, **SCHEDULE},
    "easy": {
        "preset": "easy",
        "agent.directions": 3600,  # searched as the paper's preset does it, in half of the time
        "agent.coarse-directions": 360,
        "agent.coarse-dtype": "bfloat16",
        "agent.peaks": 4,
        **SCHEDULE,
    },
}
RAW: Options = {"sizes.frame": "raw"}
PAPER: Options = {
    "preset": "paper",
    "arbiter": "episodes",
    "schedule.total-steps": 10_000_000,
    "schedule.eval-every": 100_000,
    "schedule.checkpoint-every": 10_000_000,
}
PACED: Options = {"arbiter": "paced", "arbiter.lead": 0.5}  # a shot: the lead of guided episodes for a whole share
SHUFFLED: Options = {"scalars.answer": "shuffled"}


def pieces(table: str) -> list[Piece]:
    """Return every form of feedback with every budget beside unguided agents, then controls and paced runs."""
    options = TABLES[table]
    paced = {**options, **PACED}
    return [
        Piece(table, "frame", "none", ("none",), (), 16, options),
        Piece(table, "frame", "heuristic", ("heuristic",), (), 8, options),
        *(Piece(table, "frame", kind, (kind,), BUDGETS, 8, options) for kind in ASKING),
        Piece(table, "shuffled", "relative", ("relative",), (500,), 8, {**options, **SHUFFLED}),
        *(Piece(table, "paced", kind, (kind,), (500,), 8, paced) for kind in ("relative", "intent")),
        Piece(table, "raw", "none", ("none",), (), 8, {**options, **RAW}),
        Piece(table, "raw", "relative", ("relative",), (500, 1_000), 8, {**options, **RAW}),
    ]


PIECES = (
    *pieces("regulation"),
    *pieces("easy"),
    # The paper's own figure over all its steps.
    Piece("full", "raw", "none", ("none",), (), 4, {**PAPER, **RAW}),
    Piece("full", "raw", "relative", ("relative",), (1_000,), 4, {**PAPER, **RAW}),
)

SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        seeds=2,
        labels={25: 5, 500: 10, 1_000: 15},
        options={
            **SMOKE,
            "agent.q-layers": 16,
            "agent.directions": 36,
            "agent.coarse-directions": 0,
            "sizes.num-envs": 10,
            "schedule.eval-envs": 10,
        },
    ),
    "paper": Scale("half an hour a piece on an accelerator"),
}

EXPERIMENT = Experiment(
    "billiards",
    PIECES,
    SCALES,
    report={
        "regulation": ("--level-at", "1000000", "--reference", "relative"),
        "easy": ("--level-at", "1000000", "--reference", "relative"),
    },
)
main = partial(run, EXPERIMENT, __doc__ or "")


if __name__ == "__main__":
    raise SystemExit(main())
