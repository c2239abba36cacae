"""Adapt trained navigation agents to a turned lidar, rooms, a corridor with a preferred side, and a quadruped.

    python experiments/adaptation_navigation.py --list
    python experiments/adaptation_navigation.py --bases RUN --out FOLDER [--pieces turned_lidar] [--resume]

RUN is the folder of a run of the task; all of its seeds are adapted. The pieces are data below: a method in a world, in
lanes of one program. At the scale `smoke` a piece takes seconds on a CPU, with agents of its own making.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from _adaptation import MODEST, SMALL, UNCHANGED, Piece, Scale, Study, run
from _pieces import words_of
from navigation_bootstrapping import SCALES as TRAINING

FRAME: Mapping[str, Any] = {"sizes.frame": "action"}
WIDE: Mapping[str, Any] = {**FRAME, "scalars.eps_deg": 20.0}  # in rooms small turns lead nowhere
SHUFFLED: Mapping[str, Any] = {"scalars.answer": "shuffled"}
LEARNING: Mapping[str, Any] = {"sizes.num_envs": 10, "agent.replay_capacity": 50_000}
# Five models, questions ten steps apart, 50 a round. The likeliest way is always gone: in doubt the base would act,
# which walks into walls.
WAYS: Mapping[str, Any] = {
    **WIDE,
    "sizes.labels_per_round": 50,
    "sizes.question_every": 10,
    "sizes.ensemble": 5,
    "intent.aim_doubt": 1000.0,
    "intent.aim_layers": (64, 64),
    "task.look_ahead": False,  # the scenario of rooms looks ahead
}
FARTHER: Mapping[str, Any] = {**WAYS, "task.look_ahead": True}
SEEDS = 4  # of labels


def lidar(world: str) -> list[Piece]:
    """Return the pieces of the turned lidar, or of no change as its control."""
    asked: dict[str, Any] = {"bound_deg": 60.0, "labels": (50, 100, 250), "seeds": SEEDS, "judge_by": "success"}
    tuned: dict[str, Any] = {"rate": 0.0001, "steps": 20_000, "every": 5_000, "seeds": SEEDS}
    return [
        Piece(world, "none"),
        Piece(world, "teacher", bound_deg=60.0),
        Piece(world, "relative", settings=FRAME, **asked),
        Piece(world, "relative", "narrowed", settings=FRAME, judge_bounds=(0.5, 0.25), **asked),
        Piece(world, "relative", "shuffled", settings={**FRAME, **SHUFFLED}, **asked),
        Piece(world, "reading", labels=(50, 250), seeds=2),
        Piece(world, "finetuning", settings=LEARNING, **tuned),
    ]


def rooms() -> list[Piece]:
    """Return the pieces of rooms: the paper's labels, and labels read as intent among the ways that the lidar sees."""
    asked: dict[str, Any] = {"labels": (250, 1_000), "seeds": SEEDS, "judge_by": "success"}
    return [
        Piece("rooms", "none"),
        Piece("rooms", "teacher", "180", settings=WIDE),
        Piece("rooms", "relative", "180", settings=WIDE, **asked),
        Piece("rooms", "intent", "180", settings=WAYS, **asked),
        Piece("rooms", "intent", "180-look-ahead", settings=FARTHER, **asked),
        Piece("rooms", "intent", "180-look-ahead-shuffled", settings={**FARTHER, **SHUFFLED}, **asked),
    ]


def side(name: str) -> list[Piece]:
    """Return the pieces of a preferred side: the paper's labels within 60 degrees, and read as intent within any."""
    world, judged = f"corridor_{name}", {"seeds": SEEDS, "judge_by": f"passed_{name}"}
    return [
        Piece(world, "none"),
        Piece(world, "teacher", bound_deg=60.0, settings=WIDE),
        Piece(world, "relative", bound_deg=60.0, settings=WIDE, labels=(100, 250), **judged),
        Piece(world, "intent", "180", settings=WAYS, labels=(100, 250, 1_000), **judged),
        Piece(world, "intent", "180-shuffled", settings={**WAYS, **SHUFFLED}, labels=(250, 1_000), **judged),
    ]


def quadruped(world: str, judge_by: str) -> list[Piece]:
    """Return the pieces of the simple robot's agents on the quadruped, whose physics takes most of the time."""
    asked: dict[str, Any] = {"robot": "anymal", "bound_deg": 60.0, "settings": WIDE}
    return [
        Piece(world, "none", robot="anymal"),
        Piece(world, "teacher", **asked),
        Piece(world, "relative", labels=(100, 250, 500), judge_by=judge_by, **asked),
    ]


PIECES = (
    *lidar("turned_lidar"),
    *lidar(UNCHANGED),
    *rooms(),
    *side("left"),
    *side("right"),
    *quadruped(UNCHANGED, "success"),
    *quadruped("corridor_left", "passed_left"),
)


# Tiny base agents.
BASES = words_of({**TRAINING["smoke"].options, "preset": "paper", "sizes.num-envs": 10, "guidance": "none", "seeds": 2})
SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        envs=4,
        steps=0,
        seeds=2,
        labels={50: 5, 250: 10},
        settings=SMALL,
        tuned_steps=(40, 20),
        train=BASES,
    ),
    "cpu": Scale(
        "ten minutes a piece on 2 cores: smaller models, fewer episodes, bases with 36 directions",
        envs=200,
        steps=0,
        settings=MODEST,
        tuned_steps=(10_000, 2_500),
        directions=36,
    ),
    "paper": Scale("minutes a piece on an accelerator", envs=2_000, steps=0),
}
STUDY = Study("navigation", PIECES, SCALES)
main = partial(run, STUDY, __doc__ or "")


if __name__ == "__main__":
    raise SystemExit(main())
