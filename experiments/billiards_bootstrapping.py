"""Label efficiency on the billiards tables: every form of feedback, with budgets, faults and ways to ask.

    python experiments/billiards_bootstrapping.py --list
    python experiments/billiards_bootstrapping.py --out FOLDER --pieces regulation/frame [--resume]
    python experiments/billiards_bootstrapping.py --out FOLDER --report

The sweeps are data below: every piece fits half an hour of one accelerator, has a folder of its own and is resumed.
After the pieces, or alone with --report, there is a report of each table (FOLDER/TABLE/report). Several processes may
share FOLDER, each with pieces of its own. At the scale `quick` a piece takes minutes, at `smoke` seconds on a CPU; both
have folders of their own in FOLDER.
"""

from __future__ import annotations

from collections.abc import Sequence

from _pieces import FIRST_SEED, Experiment, Options, Piece, Scale, run

FIRST, MORE = (25, 100, 500, 1_000), (50, 350, 2_000, 5_000)
CURVE = (10_000, 100_000)  # simulated: from which number on do labels pay?
ASKING = ("relative", "intent", "demonstration", "scalar", "dcoach")

REGULATION: Options = {
    "preset": "paper",
    "agent.replay-capacity": 1_000_000,  # all steps: as many as the preset's
    "schedule.total-steps": 1_000_000,
    "schedule.guidance-until": 500_000,
    "schedule.eval-every": 50_000,
    "schedule.checkpoint-every": 250_000,
}
# How far agents get alone, whom the others are measured against.
ALONE: Options = {"agent.replay-capacity": 2_000_000, "schedule.total-steps": 2_000_000}
EASY: Options = {
    "preset": "easy",
    "agent.directions": 3600,  # searched as the paper's preset does it, in half of the time
    "agent.coarse-directions": 360,
    "agent.coarse-dtype": "bfloat16",
    "agent.peaks": 4,
    "schedule.total-steps": 1_000_000,
    "schedule.guidance-until": 500_000,
    "schedule.eval-every": 50_000,
    "schedule.checkpoint-every": 250_000,
}
FULL: Options = {
    "preset": "paper",
    "schedule.total-steps": 10_000_000,
    "schedule.eval-every": 100_000,
    "schedule.checkpoint-every": 10_000_000,
}
RAW: Options = {"sizes.frame": "raw", "arbiter": "episodes"}  # said whatever the presets say
FRAME: Options = {"sizes.frame": "action", "arbiter": "episodes"}
# To the step to which areas under the curve are taken, a little past the end of guidance.
GUIDED: Options = {"schedule.total-steps": 550_000, "schedule.checkpoint-every": 550_000}
# A tenth of the labels a round, asked in as many situations at once as keep that within minutes.
MANY: Options = {
    "sizes.candidates": 100,
    "sizes.ask-all": True,
    "sizes.fit-steps": 10_000,
    "sizes.fit-batch-size": 500,
    "sizes.validate-every": 100,
}
FAULTS: dict[str, Options] = {
    "flipped-05": {"scalars.mistake-probability": 0.05},
    "flipped-10": {"scalars.mistake-probability": 0.1},
    "flipped-20": {"scalars.mistake-probability": 0.2},
    "random": {"scalars.mistake-probability": 0.5},  # leaves "already right" true, which `shuffled` does not
    "shuffled": {"scalars.answer": "shuffled"},
    "silent-20": {"scalars.silence-probability": 0.2},
    "indifferent": {"scalars.indifference-deg": 5.0},
    "biased": {"scalars.teacher-bias-deg": 2.5},
}
LEAD = 0.5  # a shot: guided episodes that earn that much more than own ones have their whole share
SURE: Options = {"intent.aim-doubt": 1_000.0}  # recorded with `scalars.aim-share` 0.8: commit 5f07753 can repeat it
WAYS: dict[str, Options] = {
    "nearest": {"scalars.answer": "nearest"},
    "ensemble": {"sizes.ensemble": 5},
    "active": {"sizes.ensemble": 5, "sizes.candidates": 16},
}


def budgets(world: str, options: Options, minutes: int) -> list[Piece]:
    """Every form of feedback with every budget seen from the action, beside agents that nobody guides.

    What relative feedback is compared with is run whole on the regulation table, and to the end of guidance elsewhere.
    """
    options = {**options, **FRAME}
    whole = world == "regulation"
    alone = {**options, **ALONE} if whole else options
    compared = options if whole else {**options, **GUIDED}
    pieces = [
        Piece(world, "frame", "none", ("none",), (), 16, alone, minutes // 2, "unguided agents, of every figure"),
        Piece(world, "frame", "heuristic", ("heuristic",), (), 8, compared, minutes // 3, "against the obvious shot"),
    ]
    for kind in ASKING:
        settings, serves = options if kind in ("relative", "intent") else compared, f"labels of {kind}"
        pieces.append(Piece(world, "frame", kind, (kind,), FIRST, 8, settings, minutes, serves))
        pieces.append(Piece(world, "frame", f"{kind}-more", (kind,), MORE, 8, options, minutes + 14, serves))
    perfect, until, serves = f"_perfect_guide:{world.upper()}", {**options, **GUIDED}, "how far guidance goes at all"
    pieces.append(Piece(world, "frame", "perfect", (perfect,), (), 8, until, minutes // 2, serves))
    return pieces


def again(world: str, options: Options, minutes: int) -> list[Piece]:
    """More seeds of what comes nearest to two thirds of the steps."""
    options, serves, first = {**options, **FRAME}, "two thirds of the steps", FIRST_SEED + 8
    return [
        Piece(world, "frame", f"intent-{labels}", ("intent",), (labels,), 16, options, minutes, serves, first)
        for labels in (500, 1_000)
    ]


def curves(world: str, options: Options, minutes: int) -> list[Piece]:
    """Return the pieces with more labels than people would give, to find the number from which labels pay."""
    options = {**options, **FRAME, **MANY, **GUIDED}
    serves = "the number from which labels pay"
    pieces = []
    for labels in CURVE:
        rounds: Options = {"sizes.labels-per-round": labels // 10, "schedule.guide-eval-every": labels // 10}
        settings = {**options, **rounds}
        pieces += [
            Piece(world, "frame", f"{kind}-{labels}", (kind,), (labels,), 8, settings, minutes, serves)
            for kind in ASKING
        ]
    return pieces


def variations(world: str, options: Options, minutes: int) -> list[Piece]:
    """Return the pieces with a faulty teacher, with other ways to ask and to answer, and with pacing."""
    options = {**options, **FRAME}
    pieces = [
        Piece(world, name, "relative", ("relative",), (500,), 8, {**options, **fault}, minutes // 2, "faulty teachers")
        for name, fault in FAULTS.items()
    ]
    pieces += [
        Piece(world, name, "relative", ("relative",), (500, 1_000), 8, {**options, **way}, minutes, "what is asked")
        for name, way in WAYS.items()
    ]
    paced: Options = {**options, "arbiter": "paced", "arbiter.lead": LEAD}
    random = {**paced, **FAULTS["random"]}
    shuffled = {**paced, **FAULTS["shuffled"]}
    any_lead: Options = {**paced, "arbiter.lead": 0.0}
    serves = "guidance never costs"
    pieces += [
        Piece(world, "paced-any-lead", "heuristic", ("heuristic",), (), 8, any_lead, minutes // 2, serves),
        Piece(world, "paced", "heuristic", ("heuristic",), (), 8, paced, minutes // 2, serves),
        Piece(world, "paced", "intent", ("intent",), (500,), 8, paced, minutes // 2, serves),
        Piece(world, "paced", "relative", ("relative",), (500,), 8, paced, minutes // 2, serves),
        Piece(world, "paced-random", "relative", ("relative",), (500,), 8, random, minutes // 2, serves),
        Piece(world, "paced-shuffled", "relative", ("relative",), (500,), 8, shuffled, minutes // 2, serves),
    ]
    return pieces


def longer(world: str, options: Options, minutes: int) -> list[Piece]:
    """Return the pieces guided to the end, in as many episodes as pays, by the best rule of `intent` alone."""
    options = {
        **options,
        **FRAME,
        "arbiter": "paced",
        "arbiter.lead": 0.0,
        "schedule.guidance-until": 1_000_000,
        **SURE,
    }
    serves = "a better guide for longer"
    return [Piece(world, "longer", "intent", ("intent",), (500, 1_000), 16, options, minutes, serves)]


def raw(world: str, options: Options, minutes: int) -> list[Piece]:
    """Return the pieces whose networks see raw coordinates."""
    options, serves = {**options, **RAW}, "the frame against raw coordinates"
    return [
        Piece(world, "raw", "none", ("none",), (), 8, options, minutes // 2, serves),
        Piece(world, "raw", "relative", ("relative",), (500, 1_000), 8, options, minutes, serves),
    ]


def full_length(minutes: int) -> list[Piece]:
    """The paper's own figure over all its steps, once."""
    options, serves = {**FULL, **RAW}, "the paper's own figure at full length"
    return [
        Piece("full", "raw", "none", ("none",), (), 4, options, minutes, serves),
        Piece("full", "raw", "relative", ("relative",), (1_000,), 4, options, minutes + 2, serves),
    ]


PIECES = (
    *budgets("regulation", REGULATION, 16),
    *again("regulation", REGULATION, 8),
    *curves("regulation", REGULATION, 16),
    *variations("regulation", REGULATION, 16),
    *longer("regulation", REGULATION, 10),
    *raw("regulation", REGULATION, 16),
    *budgets("easy", EASY, 8),
    *curves("easy", EASY, 8),
    *variations("easy", EASY, 8),
    *longer("easy", EASY, 8),
    *raw("easy", EASY, 8),
    *full_length(26),
)

SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        seeds=2,
        labels={25: 5, 500: 10, 10_000: 15},
        options={
            "agent.q-layers": 16,
            "sizes.feedback-layers": 16,
            "agent.directions": 36,
            "agent.coarse-directions": 0,
            "sizes.num-envs": 10,
            "agent.replay-capacity": 200,
            "sizes.labels-per-round": 5,
            "sizes.fit-steps": 20,
            "sizes.fit-batch-size": 10,
            "sizes.validate-every": 20,
            "sizes.lanes-per-block": 1,
            "schedule.total-steps": 200,
            "schedule.random-steps": 50,
            "schedule.learn-after": 50,
            "schedule.guidance-until": 200,
            "schedule.eval-every": 100,
            "schedule.eval-steps": 100,
            "schedule.eval-envs": 10,
            "schedule.checkpoint-every": 200,
        },
        instead={"sizes.candidates": 5, "schedule.guide-eval-every": 5},
    ),
    "quick": Scale(
        "minutes a piece on an accelerator, to see where it goes",
        seeds=4,
        labels={100: 100, 500: 500, 1_000: 1_000, 10_000: 10_000},
        options={
            "agent.replay-capacity": 200_000,
            "schedule.total-steps": 200_000,
            "schedule.guidance-until": 100_000,
            "schedule.eval-every": 20_000,
            "schedule.checkpoint-every": 100_000,
        },
    ),
    "paper": Scale("what is reported", reported=True),
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for; return the exit status."""
    return run(EXPERIMENT, __doc__ or "", arguments)


if __name__ == "__main__":
    raise SystemExit(main())
