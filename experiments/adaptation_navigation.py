"""Adapt trained navigation agents to a turned lidar, rooms, a corridor with a preferred side, and a quadruped.

    python experiments/adaptation_navigation.py --list
    python experiments/adaptation_navigation.py --bases RUN --out FOLDER [--pieces turned_lidar] [--resume]
    python experiments/adaptation_page.py --data FOLDER

RUN is the folder of a run of the task; all of its seeds are adapted. The pieces are data below: a method in a world, in
lanes of one program. Those below `tuning/`, on the episodes on which settings are chosen, run only when they are named.
At the scale `quick` a piece takes minutes, at `smoke` seconds on a CPU, with agents of its own making.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from _adaptation import MODEST, SMALL, UNCHANGED, Piece, Scale, Study, run
from _pieces import option
from navigation_bootstrapping import SCALES as TRAINING

LIDAR, ROOMS, QUADRUPED = "turned_lidar", "rooms", "anymal"
LIDAR_BOUND_DEG, ROOMS_BOUND_DEG, SIDE_BOUND_DEG = 60.0, 180.0, 60.0
BUDGETS = (50, 100, 250)
LABEL_SEEDS = 4
TUNED = (250,)

FRAME: Mapping[str, Any] = {"sizes.frame": "action"}
TURN: Mapping[str, Any] = {**FRAME, "guidance": "offset"}  # recorded as `sizes.sees_turn`
ROOMY: Mapping[str, Any] = {**FRAME, "scalars.eps_deg": 20.0}  # in rooms small turns lead nowhere
SIDED: Mapping[str, Any] = {**TURN, "scalars.eps_deg": 20.0}
SLOWLY: Mapping[str, Any] = {**FRAME, "scalars.eps_deg": 20.0, "scalars.feedback_learning_rate": 3e-4}
SHUFFLED: Mapping[str, Any] = {"scalars.answer": "shuffled"}
NARROWER = (0.5, 0.25)  # shares of a bound that are tried on tuning episodes
LEARNING: Mapping[str, Any] = {"sizes.num_envs": 10, "agent.replay_capacity": 50_000}
# As chosen by tuning/turned_lidar/finetuning: a tenth of the step size of training.
RATES, NOISES_DEG, STEPS, EVERY = (0.0001,), (0.0,), 20_000, 5_000

# Settings that are compared on tuning episodes, by method: as many of each.
COMPARED: dict[str, dict[str, Mapping[str, Any]]] = {
    "relative": {
        "frame": FRAME,
        "turn-5": {**TURN, "scalars.eps_deg": 5.0},
        "turn-10": {**TURN, "scalars.eps_deg": 10.0},
        "turn-20": {**TURN, "scalars.eps_deg": 20.0},
    },
    "residual": {
        "three-times": FRAME,
        "turn": TURN,
        "once": {**FRAME, "scalars.k_max": 1, "scalars.refined_fraction": 0.0},
        "raw": {"sizes.frame": "raw"},
    },
    "dcoach": {
        "default": {**FRAME, "scalars.eps_deg": 20.0},
        "slow": SLOWLY,
        "fast": {**FRAME, "scalars.eps_deg": 20.0, "scalars.feedback_learning_rate": 3e-3},
        "raw": {"sizes.frame": "raw", "scalars.eps_deg": 20.0},
    },
}
# In rooms: what helps, each by itself and together. A round is 50 questions, so that a thousand are 20 fits.
EACH: Mapping[str, Any] = {
    **FRAME,
    "scalars.eps_deg": 20.0,
    "sizes.labels_per_round": 50,
    "task.look_ahead": False,  # the scenario looks ahead
}
SPACED = {"sizes.question_every": 10}
LOOK_AHEAD = {"task.look_ahead": True}
# The likeliest way is always gone: in doubt the base would act, which walks into walls.
SURE: Mapping[str, Any] = {**EACH, **SPACED, "intent.aim_doubt": 1000.0, "intent.aim_layers": (64, 64)}
MEMBERS, ACTIVE = {"sizes.ensemble": 5}, {"sizes.ensemble": 5, "sizes.candidates": 16, "sizes.question_every": 1}
IN_ROOMS: dict[str, dict[str, Mapping[str, Any]]] = {
    "intent": {
        "members": {**SURE, **MEMBERS},
        "active": {**SURE, **ACTIVE},
        "look-ahead-only": {**SURE, **MEMBERS, **LOOK_AHEAD},
        "contrary": {**SURE, **MEMBERS, "scalars.mistake_probability": 0.5},  # leaves "already right" true
        "shuffled": {**SURE, **MEMBERS, "scalars.answer": "shuffled"},  # do labels matter at all?
        "doubting": {**SURE, **MEMBERS, "intent.aim_doubt": 2.0},
        "small": {**SURE, **MEMBERS, "intent.aim_layers": (32, 32)},
        "close": {**SURE, **MEMBERS, "sizes.question_every": 1},
        "eps-10": {**SURE, **MEMBERS, "scalars.eps_deg": 10.0},
        "eps-40": {**SURE, **MEMBERS, "scalars.eps_deg": 40.0},
    },
    "relative": {
        "close": EACH,
        "spaced": {**EACH, **SPACED},
        "spaced-members": {**EACH, **SPACED, **MEMBERS},
    },
}
BEST_IN_ROOMS = SIDED_INTENT = IN_ROOMS["intent"]["members"]
FARTHER_IN_ROOMS = IN_ROOMS["intent"]["look-ahead-only"]
SWEPT_RATES, SWEPT_NOISES_DEG = (0.0001, 0.001), (0.0, 5.0)


def compared(world: str, bound: float, judge_by: str, methods: Mapping[str, Mapping[str, Any]]) -> list[Piece]:
    """Methods with every setting that is tried."""
    return [
        Piece(
            world,
            method,
            variant,
            bound,
            TUNED,
            settings,
            split="tuning",
            judge_by=judge_by,
            minutes=5,
            serves=f"settings of {method}",
        )
        for method, variants in methods.items()
        for variant, settings in variants.items()
    ]


def every_method(world: str) -> list[Piece]:
    """Every method in a world, and relative labels whose answers were shuffled."""
    serves, bound = "success with a turned lidar", LIDAR_BOUND_DEG
    asked = {"bound_deg": bound, "labels": BUDGETS, "seeds": LABEL_SEEDS, "judge_by": "success", "serves": serves}
    learns = {"settings": LEARNING, "rates": RATES, "noises_deg": NOISES_DEG, "steps": STEPS, "every": EVERY}
    read: dict[str, Any] = {"labels": (50, 250), "seeds": 2, "judge_by": "labels", "minutes": 20, "serves": serves}
    return [
        Piece(world, "none", minutes=2, serves=serves),
        Piece(world, "relative", settings=FRAME, minutes=15, **asked),
        Piece(world, "relative", "narrowed", settings=FRAME, minutes=18, judge_bounds=NARROWER, **asked),
        Piece(world, "relative", "shuffled", settings={**FRAME, **SHUFFLED}, minutes=15, **asked),
        Piece(world, "reading", **read),
        Piece(world, "reading", "shuffled", **read),
        Piece(world, "dcoach", settings=SLOWLY, minutes=15, **asked),
        Piece(world, "residual", settings=TURN, minutes=15, **asked),
        Piece(world, "finetuning", minutes=25, seeds=LABEL_SEEDS, serves=serves, **learns),
    ]


def lidar() -> list[Piece]:
    """The table of the turned lidar, and of no change as its control; with what was compared."""
    world, serves, bound = LIDAR, "success with a turned lidar", LIDAR_BOUND_DEG
    swept = {"settings": LEARNING, "rates": SWEPT_RATES, "noises_deg": SWEPT_NOISES_DEG}
    return [
        *every_method(UNCHANGED),
        *every_method(world),
        Piece(world, "teacher", bound_deg=bound, minutes=4, serves=serves),
        *compared(world, bound, "success", COMPARED),
        *compared(world, 180.0, "success", {"intent": {"members-180": SIDED_INTENT}}),
        Piece(
            world,
            "finetuning",
            split="tuning",
            steps=20_000,
            every=5_000,
            minutes=20,
            serves="settings of finetuning",
            **swept,
        ),
    ]


def rooms() -> list[Piece]:
    """The table of the rooms: unadapted, by the road map, and learned.

    The paper's labels, refined in the action frame; then read as intent among the ways that the lidar sees, asked in
    situations farther apart, and with look-ahead too; the last with answers shuffled as well.
    """
    asked = {"bound_deg": ROOMS_BOUND_DEG, "serves": "success in rooms"}
    learned = {**asked, "labels": (250, 1_000), "seeds": LABEL_SEEDS, "judge_by": "success", "minutes": 25}
    pieces = [
        Piece(ROOMS, "none", minutes=2, serves="success in rooms"),
        Piece(ROOMS, "teacher", "180", minutes=5, settings=ROOMY, **asked),
        Piece(ROOMS, "relative", "180", settings=ROOMY, **learned),
        Piece(ROOMS, "intent", "180-members", settings=BEST_IN_ROOMS, **learned),
        Piece(ROOMS, "intent", "180-look-ahead", settings=FARTHER_IN_ROOMS, **learned),
        Piece(ROOMS, "intent", "180-look-ahead-shuffled", settings={**FARTHER_IN_ROOMS, **SHUFFLED}, **learned),
    ]
    ablation = compared(ROOMS, ROOMS_BOUND_DEG, "success", IN_ROOMS)
    return [*pieces, *(piece._replace(labels=(250, 1_000)) for piece in ablation)]


def sides() -> list[Piece]:
    """The preferred side in the corridor: the paper's labels within 60 degrees, and read as intent within any.

    Of the latter also among ways that tell where a second leg would lead.
    """
    pieces = []
    for side in ("left", "right"):
        world, judge_by, serves = f"corridor_{side}", f"passed_{side}", "the preferred side"
        asked = {"bound_deg": SIDE_BOUND_DEG, "settings": SIDED, "judge_by": judge_by, "serves": serves}
        wide = {**asked, "variant": "180", "bound_deg": 180.0, "settings": SIDED_INTENT}
        farther = {**wide, "variant": "180-look-ahead", "settings": {**SIDED_INTENT, **LOOK_AHEAD}}
        shuffled = {**wide, "variant": "180-shuffled", "settings": {**SIDED_INTENT, **SHUFFLED}}
        pieces += [
            Piece(world, "none", minutes=2, serves=serves),
            Piece(world, "teacher", minutes=4, **asked),
            Piece(world, "relative", labels=(100, 250), seeds=LABEL_SEEDS, ways=True, minutes=25, **asked),
            Piece(world, "intent", labels=(100, 250, 1_000), seeds=LABEL_SEEDS, ways=True, minutes=25, **wide),
            Piece(world, "intent", labels=(250, 1_000), seeds=LABEL_SEEDS, minutes=25, **farther),
            Piece(world, "intent", labels=(250, 1_000), seeds=LABEL_SEEDS, minutes=25, **shuffled),
        ]
    tried = {"relative": COMPARED["relative"], "intent": {"members": SIDED_INTENT}}
    freely = {
        "members-180": SIDED_INTENT,
        "active-180": {**SIDED_INTENT, **ACTIVE},
        "look-ahead-180": {**SIDED_INTENT, **LOOK_AHEAD},
    }
    wide = compared("corridor_left", 180.0, "passed_left", {"intent": freely})
    return [*pieces, *compared("corridor_left", SIDE_BOUND_DEG, "passed_left", tried), *wide]


def quadruped() -> list[Piece]:
    """The kinematic robot's agents on the quadruped: in their own halls, in the corridor, and there with a wish.

    Labels are asked while it walks; its physics takes most of the time.
    """
    pieces = []
    for world, judge_by, serves, settings in (
        (UNCHANGED, "success", "success on the quadruped", FRAME),
        ("corridor_left", "passed_left", "the preferred side on the quadruped", SIDED),
    ):
        changed: dict[str, Any] = {"robot": QUADRUPED, "serves": serves}
        asked = {**changed, "bound_deg": SIDE_BOUND_DEG, "settings": settings}
        pieces += [
            Piece(world, "none", minutes=5, **changed),
            Piece(world, "teacher", minutes=8, **asked),
            Piece(world, "relative", labels=(100, 250, 500), judge_by=judge_by, minutes=25, **asked),
        ]
    return pieces


UNADAPTED = [
    Piece(UNCHANGED, "none", split="tuning", minutes=2, serves="which agents are finished"),
]
PIECES = tuple(
    sorted(
        [*UNADAPTED, *lidar(), *rooms(), *sides(), *quadruped()], key=lambda piece: piece.split == "tuning"
    )  # those of tables first
)


def bases() -> list[str]:
    """Return the command-line options for training tiny base agents."""
    own = {**TRAINING["smoke"].options, "preset": "paper", "sizes.num-envs": 10, "guidance": "none", "seeds": 2}
    return [word for name, value in own.items() for word in option(name, value)]


SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        envs=4,
        steps=0,
        tuning_bases=1,
        seeds=2,
        labels={50: 5, 250: 10},
        settings=SMALL,
        tuned_steps=(40, 20),
        train=bases(),
    ),
    "cpu": Scale(
        "ten minutes a piece on 2 cores: smaller models, fewer episodes, bases with 36 directions",
        envs=200,
        steps=0,
        labels={100: 100, 250: 250, 500: 500, 1_000: 1_000},
        settings=MODEST,
        tuned_steps=(10_000, 2_500),
        directions=36,
    ),
    "quick": Scale(
        "minutes a piece on an accelerator, to see where it goes",
        envs=200,
        steps=0,
        labels={100: 100, 250: 250, 500: 500, 1_000: 1_000},
        tuned_steps=(10_000, 2_500),
    ),
    "paper": Scale("what is reported", envs=2_000, steps=0),
}

STUDY = Study("navigation", PIECES, SCALES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for; return the exit status."""
    return run(STUDY, __doc__ or "", arguments)


if __name__ == "__main__":
    raise SystemExit(main())
