"""Why agents here do not learn in two thirds of the steps, as the paper's do: one difference to it at a time.

    python experiments/paper_third.py --list
    python experiments/paper_third.py --out FOLDER --pieces third/raw [--resume]
    python experiments/paper_third.py --out FOLDER --report

The preset `paper` to 3 million steps with 1,000 labels, 16 paired seeds. Then the same with refined uniform actions in
guided episodes, with fits of up to 10,000 epochs, and with an agent as the teacher: train `teacher/raw` first. Last, 8
seeds with and without labels where Chipmunk plays the shots in steps of 0.02 s, as the public code's simulator does.
"""

from __future__ import annotations

from collections.abc import Sequence

from _pieces import Experiment, Options, Piece, Scale, run
from billiards_bootstrapping import FULL, RAW
from billiards_bootstrapping import SCALES as OTHERS

SEEDS, LABELS = 16, (1_000,)
THIRD: Options = {
    "preset": "paper",
    **RAW,
    "agent.replay-capacity": 3_000_000,
    "schedule.total-steps": 3_000_000,
    "schedule.eval-every": 100_000,
    "schedule.checkpoint-every": 3_000_000,
}
# 800 of 1,000 labels train: 16,000 batches of 500 are 10,000 epochs. A round is 100 labels, so that there are ten fits.
EPOCHS: Options = {
    "sizes.fit-steps": 16_000,
    "sizes.fit-batch-size": 500,
    "sizes.validate-every": 100,
    "sizes.labels-per-round": 100,
    "schedule.guide-eval-every": 100,
}
TEACHER = "runs/paper_third/teacher/raw/none"  # what the piece `teacher/raw/none` leaves at the scale paper
BY_AN_AGENT: Options = {"task.teacher": TEACHER, "task.aim-error-deg": 0.0}


def third(run: str, kind: str, labels: tuple[int, ...], serves: str, **options: object) -> Piece:
    """Agents of 3 million steps under one kind of guidance."""
    settings = {**THIRD, **options}
    return Piece("third", run, kind.partition(":")[0].strip("_"), (kind,), labels, SEEDS, settings, 20, serves)


def in_coarse_steps(kind: str, labels: tuple[int, ...]) -> Piece:
    """Half as many agents where Chipmunk plays: the processor plays a few hundred shots a second on each core."""
    piece = third("raw", kind, labels, "a coarse step of simulation", robot="chipmunk")
    return piece._replace(world="coarse", seeds=SEEDS // 2)


PIECES = (
    third("raw", "none", (), "more seeds, farther"),
    third("raw", "relative", LABELS, "more seeds, farther"),
    third("from-chance", "_from_chance:KIND", LABELS, "uniform actions are refined"),
    third("epochs", "relative", LABELS, "longer fits", **EPOCHS),
    Piece("teacher", "raw", "none", ("none",), (), 1, {**FULL, **RAW}, 25, "an agent of 10 million steps, the teacher"),
    third("by-an-agent", "relative", (500, 1_000), "an agent is the teacher", **BY_AN_AGENT),
    in_coarse_steps("none", ()),
    in_coarse_steps("relative", LABELS),
)
SMALL = OTHERS["smoke"]
SCALES = {
    "smoke": SMALL._replace(
        options={**SMALL.options, "arbiter": "episodes"},
        labels={500: 10, 1_000: 15},
        instead={**SMALL.instead, "task.teacher": "runs/paper_third/smoke/teacher/raw/none"},
    ),
    "paper": Scale("what is reported", reported=True),
}
REPORT = {"third": ("--level-at", "3000000"), "coarse": ()}
EXPERIMENT = Experiment("_agent_teacher:TASK", PIECES, SCALES, REPORT, folder="paper_third")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for; return the exit status."""
    return run(EXPERIMENT, __doc__ or "", arguments)


if __name__ == "__main__":
    raise SystemExit(main())
