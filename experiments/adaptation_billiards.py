"""Adapt trained billiards agents in three changed worlds: labels against fine-tuning.

    python experiments/adaptation_billiards.py --list
    python experiments/adaptation_billiards.py --bases RUN --out FOLDER [--pieces tilted_table] [--resume]

RUN is the folder of a run of the preset `regulation`; all of its seeds are adapted. The pieces are data below: a method
in a world, in lanes of one program. At the scale `smoke` a piece takes seconds on a CPU, with agents of its own making.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from _adaptation import MODEST, SMALL, UNCHANGED, Piece, Scale, Study, run
from _pieces import words_of
from billiards_bootstrapping import SCALES as TRAINING

BOUNDS_DEG = {UNCHANGED: 1.0, "turned_strike": 1.0, "shifted_balls": 0.3, "tilted_table": 0.3}
# The teacher is one that plays its shots in the changed world, and means the shot that is nearest to the agent's own.
ASKED: Mapping[str, Any] = {
    "task.teacher": "local_search",
    "scalars.answer": "nearest",
    "scalars.nearest_aim_deg": 0.1,
    "scalars.nearest_share": 0.9,
    "scalars.eps_deg": 0.1,
}
SLOW: Mapping[str, Any] = {**ASKED, "scalars.feedback_learning_rate": 3e-4}
LEARNING: Mapping[str, Any] = {"task.teacher": "local_search", "sizes.num_envs": 10, "agent.replay_capacity": 100_000}


def pieces(world: str, bound: float) -> list[Piece]:
    """Return the pieces of a world; in the unchanged one they show whether a method harms a policy that is right."""
    asked: dict[str, Any] = {"bound_deg": bound, "labels": (50, 100, 250), "seeds": 4}
    rate, noise = (0.05, 0.6) if world == "turned_strike" else (0.01, 0.3)
    tuned: dict[str, Any] = {"rate": rate, "noise_deg": noise, "steps": 60_000, "every": 10_000, "seeds": 4}
    return [
        Piece(world, "none"),
        Piece(world, "teacher", settings=ASKED, bound_deg=bound),
        Piece(world, "relative", settings=SLOW, **asked),
        Piece(world, "relative", "shuffled", settings={**SLOW, "scalars.answer": "shuffled"}, **asked),
        Piece(world, "reading", settings=ASKED, bound_deg=bound, labels=(50, 100), seeds=2),
        Piece(world, "finetuning", settings=LEARNING, **tuned),
    ]


PIECES = tuple(piece for world, bound in BOUNDS_DEG.items() for piece in pieces(world, bound))


# Tiny base agents.
BASES = words_of({**TRAINING["smoke"].options, "preset": "regulation", "guidance": "none", "seeds": 2})
SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        envs=4,
        steps=3,
        seeds=2,
        labels={50: 5, 250: 10},
        settings=SMALL,
        tuned_steps=(40, 20),
        train=BASES,
    ),
    "cpu": Scale(
        "ten minutes a piece on 2 cores: smaller models, fewer episodes",
        envs=100,
        steps=20,
        labels={100: 100, 250: 250},
        settings=MODEST,
        tuned_steps=(10_000, 2_500),
    ),
    "paper": Scale("minutes a piece on an accelerator", envs=200, steps=50),
}
STUDY = Study("billiards", PIECES, SCALES)
main = partial(run, STUDY, __doc__ or "")


if __name__ == "__main__":
    raise SystemExit(main())
