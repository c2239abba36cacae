"""Label efficiency in navigation: every form of feedback, with budgets, faults and ways to ask, in both frames.

    python experiments/navigation_bootstrapping.py --list
    python experiments/navigation_bootstrapping.py --out FOLDER --pieces clutter/frame [--resume]
    python experiments/navigation_bootstrapping.py --out FOLDER --report

The sweeps are data below: every piece fits half an hour of one accelerator, has a folder of its own and is resumed.
After the pieces, or alone with --report, there is a report (FOLDER/clutter/report). Several processes may share FOLDER,
each with pieces of its own. At the scale `quick` a piece takes minutes, at `cpu` ten minutes on one core (45 for five
models), at `smoke` seconds on a CPU; all have folders of their own in FOLDER.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from _pieces import Experiment, Options, Piece, Scale, run

FEW, MANY = (25, 50, 100), (350, 500, 1_000)
ASKING = ("relative", "demonstration", "scalar", "dcoach")
SEEDS, VARIED_SEEDS = 16, 8

HALLS: Options = {
    "preset": "paper",
    "schedule.total-steps": 100_000,
    "schedule.guidance-until": 100_000,
    "schedule.eval-every": 10_000,
    "schedule.eval-envs": 200,
    "schedule.eval-steps": 40_000,
    "schedule.checkpoint-every": 50_000,
}
# Long enough for what is compared over the first 40,000 steps alone.
HALF: Options = {"schedule.total-steps": 50_000, "schedule.guidance-until": 50_000}
RAW: Options = {"sizes.frame": "raw", "arbiter": "episodes"}  # said whatever the presets say
FRAME: Options = {"sizes.frame": "action", "arbiter": "episodes"}
LEAD = 10.0  # a return: guided episodes that earn that much more than own ones have their whole share
FAULTS: dict[str, Options] = {
    "flipped-05": {"scalars.mistake-probability": 0.05},
    "flipped-10": {"scalars.mistake-probability": 0.1},
    "flipped-20": {"scalars.mistake-probability": 0.2},
    "random": {"scalars.mistake-probability": 0.5},  # leaves "already right" true, which `shuffled` does not
    "shuffled": {"scalars.answer": "shuffled"},
    "silent-20": {"scalars.silence-probability": 0.2},
    "indifferent": {"scalars.indifference-deg": 20.0},
    "biased": {"scalars.teacher-bias-deg": 10.0},
}
# Given on the labelling page by a script that sees the page alone, and errs (docs/labels.md).
PAGE = Path(__file__).parents[1] / "docs/data/labelling/navigation/labels.parquet"
WAYS: dict[str, Options] = {
    # Labels in three instalments, the later ones about the agent's own actions: commit 5f07753 can repeat it.
    "instalments": {"schedule.ask-at": (0, 20_000, 40_000), "scalars.ask-bound-deg": 60.0},
    "ensemble": {"sizes.ensemble": 5},
    "active": {"sizes.ensemble": 5, "sizes.candidates": 16},
}


def budgets(name: str, options: Options, minutes: int) -> list[Piece]:
    """Every form of feedback with every budget, beside agents that nobody guides; some half as long."""
    whole = {**HALLS, **options}
    half = {**whole, **HALF}
    alone = whole if name == "frame" else half  # those seen from the action are whom all others are compared with
    pieces = [
        Piece("clutter", name, "none", ("none",), (), SEEDS, alone, minutes // 2, "unguided agents, of every figure"),
        Piece("clutter", name, "heuristic", ("heuristic",), (), SEEDS, half, minutes // 4, "against walking straight"),
    ]
    for kind in ASKING:
        serves, many = f"labels of {kind}", whole if name == "raw" else half
        pieces.append(Piece("clutter", name, f"{kind}-few", (kind,), FEW, SEEDS, whole, minutes, serves))
        pieces.append(Piece("clutter", name, f"{kind}-many", (kind,), MANY, SEEDS, many, minutes + 3, serves))
    return pieces


def variations(minutes: int) -> list[Piece]:
    """Five hundred labels of a faulty teacher, and other ways to ask; then paced."""
    options = {**HALLS, **FRAME, **HALF}
    relative, seeds, brief = ("relative",), VARIED_SEEDS, minutes // 2
    pieces = [
        Piece("clutter", name, "relative", relative, (500,), seeds, {**options, **fault}, brief, "faulty teachers")
        for name, fault in FAULTS.items()
    ]
    pieces += [
        Piece("clutter", name, "relative", relative, (100, 500), seeds, {**options, **way}, minutes, "what is asked")
        for name, way in WAYS.items()
    ]
    paced: Options = {**options, "arbiter": "paced", "arbiter.lead": LEAD}
    given: Options = {**options, "labels-from": PAGE}
    serves = "labels given on the page"
    pieces.append(Piece("clutter", "page", "relative", relative, (450, 500), seeds, given, brief, serves))
    random = {**paced, **FAULTS["random"]}
    shuffled = {**paced, **FAULTS["shuffled"]}
    serves = "guidance never costs"
    pieces += [
        Piece("clutter", "paced", "heuristic", ("heuristic",), (), seeds, paced, brief, serves),
        Piece("clutter", "paced", "relative", relative, (500,), seeds, paced, brief, serves),
        Piece("clutter", "paced-random", "relative", relative, (500,), seeds, random, brief, serves),
        Piece("clutter", "paced-shuffled", "relative", relative, (500,), seeds, shuffled, brief, serves),
    ]
    return pieces


PIECES = (*budgets("frame", FRAME, 16), *budgets("raw", RAW, 16), *variations(16))

SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        seeds=2,
        labels={25: 5, 350: 10, 450: 14, 500: 15},
        options={
            "task.worlds": 2,
            "task.max-steps": 20,
            "agent.q-layers": 16,
            "sizes.feedback-layers": 16,
            "agent.directions": 12,
            "agent.target-directions": 6,
            "agent.n-step": 3,
            "agent.replay-capacity": 200,
            "sizes.labels-per-round": 5,
            "sizes.fit-steps": 20,
            "sizes.fit-batch-size": 10,
            "sizes.lanes-per-block": 1,
            "schedule.total-steps": 200,
            "schedule.random-steps": 50,
            "schedule.learn-after": 50,
            "schedule.guidance-until": 200,
            "schedule.eval-every": 100,
            "schedule.eval-envs": 5,
            "schedule.eval-steps": 100,
            "schedule.checkpoint-every": 200,
        },
    ),
    "cpu": Scale(
        "ten minutes a piece on one core, 45 for five models: the networks of the preset quickstart, 12,000 steps",
        seeds=8,
        labels={100: 100, 500: 500},
        options={
            "agent.q-layers": (128, 128),
            "sizes.feedback-layers": (128, 128),
            "agent.directions": 36,
            "agent.target-directions": 12,
            "agent.batch-size": 64,
            "agent.replay-capacity": 50_000,
            "sizes.fit-steps": 400,
            "sizes.fit-batch-size": 64,
            "agent.learning-rate": 0.003,
            "schedule.total-steps": 12_000,
            "schedule.guidance-until": 12_000,
            "schedule.eval-every": 2_000,
            "schedule.eval-envs": 30,
            "schedule.eval-steps": 6_000,
            "schedule.checkpoint-every": 12_000,
        },
        reported=True,
    ),
    "quick": Scale(
        "minutes a piece on an accelerator, to see where it goes",
        seeds=4,
        labels={100: 100, 500: 500},
        options={
            "schedule.total-steps": 50_000,
            "schedule.guidance-until": 30_000,
            "schedule.eval-every": 5_000,
            "schedule.checkpoint-every": 50_000,
        },
    ),
    "paper": Scale("what is reported", reported=True),
}

EXPERIMENT = Experiment(
    "navigation",
    PIECES,
    SCALES,
    report={"clutter": ("--level", "0.9", "--within", "1", "--reference", "relative")},
    metric=("--metric", "success"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for; return the exit status."""
    return run(EXPERIMENT, __doc__ or "", arguments)


if __name__ == "__main__":
    raise SystemExit(main())
