"""Adapt trained billiards agents in three changed worlds: labels against fine-tuning and other baselines.

    python experiments/adaptation_billiards.py --list
    python experiments/adaptation_billiards.py --bases RUN --out FOLDER [--pieces tilted_table] [--resume]
    python experiments/adaptation_page.py --data FOLDER

RUN is the folder of a run of the preset `regulation`; all of its seeds are adapted. The pieces are data below: a method
in a world, in lanes of one program. Those below `tuning/`, on the episodes on which settings are chosen, run only when
they are named. At the scale `quick` a piece takes minutes, at `smoke` seconds on a CPU, with agents of its own making.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from _adaptation import MODEST, SMALL, UNCHANGED, Piece, Scale, Study, run
from _pieces import option
from billiards_bootstrapping import SCALES as TRAINING

BOUNDS_DEG = {"turned_strike": 1.0, "shifted_balls": 0.3, "tilted_table": 0.3}
PLAYED = {UNCHANGED: 1.0, **BOUNDS_DEG}
BUDGETS = (50, 100, 250)
EVIDENCE = (50, 100)  # of a reading
LABEL_SEEDS = 4
TUNED = (250,)
BY_LABELS = ("relative", "residual", "dcoach")
LEAST = 0.395  # reward of a base agent in the unchanged world, on tuning episodes: others are no finished agents

# The teacher is one that plays its shots in the changed world, and means the shot that is nearest to the agent's own.
ASKED: Mapping[str, Any] = {
    "task.teacher": "local_search",
    "scalars.answer": "nearest",
    "scalars.nearest_aim_deg": 0.1,
    "scalars.nearest_share": 0.9,
    "scalars.eps_deg": 0.1,
}
TURN: Mapping[str, Any] = {"guidance": "offset"}  # recorded as `sizes.sees_turn`
LEARNING: Mapping[str, Any] = {"task.teacher": "local_search", "sizes.num_envs": 10, "agent.replay_capacity": 100_000}
STEPS, EVERY = 60_000, 10_000
# As chosen on tuning episodes, see docs/results/adaptation.md.
SLOW: Mapping[str, Any] = {"scalars.feedback_learning_rate": 3e-4}
FAST: Mapping[str, Any] = {"scalars.feedback_learning_rate": 3e-3}
RAW: Mapping[str, Any] = {"sizes.frame": "raw"}
SHUFFLED: Mapping[str, Any] = {"scalars.answer": "shuffled"}
ONCE: Mapping[str, Any] = {"scalars.k_max": 1, "scalars.refined_fraction": 0.0}
SHARE_60: Mapping[str, Any] = {"scalars.nearest_share": 0.6}
# Step size and noise [deg] of fine-tuning: swept in one world, a tenth of the step size of training in the others.
LEARNED: dict[str, tuple[float, float]] = {"turned_strike": (0.05, 0.6)}
LEARNED_ELSEWHERE = (0.01, 0.3)
BEST: dict[tuple[str, str], Mapping[str, Any]] = {
    **{(world, "relative"): {**TURN, **SLOW} for world in PLAYED},
    ("tilted_table", "relative"): {**TURN, **SLOW, **SHARE_60},
    ("tilted_table", "teacher"): SHARE_60,
    **{(world, "residual"): TURN for world in PLAYED},
    **{(world, "dcoach"): FAST for world in PLAYED},
}

# Settings that are compared on tuning episodes, by method: as many of each.
COMPARED: dict[str, dict[str, Mapping[str, Any]]] = {
    "relative": {
        "turn": TURN,
        "turn-slow": {**TURN, **SLOW},
        "turn-share-60": {**TURN, **SLOW, **SHARE_60},
        "raw": RAW,
    },
    "residual": {"turn": TURN, "turn-slow": {**TURN, **SLOW}, "three-times": {}, "once": ONCE},
    "dcoach": {"default": {}, "slow": SLOW, "fast": FAST, "fast-large": {**FAST, "scalars.eps_deg": 0.3}},
}
SWEPT_RATES, SWEPT_NOISES_DEG = (0.01, 0.05), (0.15, 0.6)


def compared(world: str, bound: float) -> list[Piece]:
    """Every method with every setting that is tried; fine-tuning's are lanes of one piece."""
    pieces = [
        Piece(
            world,
            method,
            variant,
            bound,
            TUNED,
            {**ASKED, **settings},
            split="tuning",
            minutes=4,
            serves=f"settings of {method}",
        )
        for method, variants in COMPARED.items()
        for variant, settings in variants.items()
    ]
    swept = {"rates": SWEPT_RATES, "noises_deg": SWEPT_NOISES_DEG, "steps": 20_000, "every": 5_000}
    learns = Piece(world, "finetuning", settings=LEARNING, split="tuning", minutes=8, **swept)
    return [*pieces, learns._replace(serves="settings of finetuning")]


def reported(world: str, bound: float) -> list[Piece]:
    """The figure of a world: every method, and relative labels whose answers were shuffled.

    Of the unchanged world too, where nothing is to be gained: what do methods do to a policy that is right?
    """
    serves = "reward as a share of the original"
    asked = {"bound_deg": bound, "serves": serves}
    learned: dict[str, Any] = {**asked, "labels": BUDGETS, "seeds": LABEL_SEEDS, "minutes": 8}
    read = {**learned, "labels": EVIDENCE, "seeds": 2, "minutes": 15}
    best = {method: {**ASKED, **BEST.get((world, method), {})} for method in ("teacher", *BY_LABELS)}
    rate, noise = LEARNED.get(world, LEARNED_ELSEWHERE)
    learns = {"rates": (rate,), "noises_deg": (noise,), "steps": STEPS, "every": EVERY}
    return [
        Piece(world, "none", minutes=1, serves=serves),
        Piece(world, "teacher", minutes=2, settings=best["teacher"], **asked),
        *(Piece(world, method, settings=best[method], **learned) for method in BY_LABELS),
        Piece(world, "relative", "shuffled", settings={**best["relative"], **SHUFFLED}, **learned),
        Piece(world, "reading", settings=ASKED, **read),
        Piece(world, "reading", "shuffled", settings=ASKED, **read),
        Piece(world, "finetuning", settings=LEARNING, minutes=20, seeds=LABEL_SEEDS, serves=serves, **learns),
    ]


PIECES = (
    Piece(UNCHANGED, "none", split="tuning", minutes=1, serves="which agents are finished"),
    *(piece for world, bound in PLAYED.items() for piece in reported(world, bound)),
    *(piece for world, bound in BOUNDS_DEG.items() for piece in compared(world, bound)),
)


def bases(**options: Any) -> list[str]:
    """Return the command-line options for training tiny base agents."""
    own = {**TRAINING["smoke"].options, "preset": "regulation", "guidance": "none", "seeds": 2, **options}
    return [word for name, value in own.items() for word in option(name, value)]


SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        envs=4,
        steps=3,
        tuning_bases=1,
        seeds=2,
        labels={25: 5, 50: 10, 250: 10},
        settings=SMALL,
        tuned_steps=(40, 20),
        train=bases(),
    ),
    "cpu": Scale(
        "ten minutes a piece on 2 cores: smaller models, fewer episodes",
        envs=100,
        steps=20,
        labels={100: 100, 250: 250},
        settings=MODEST,
        tuned_steps=(10_000, 2_500),
    ),
    "quick": Scale(
        "a minute a piece on an accelerator, to see where it goes",
        envs=100,
        steps=20,
        labels={100: 100, 250: 250, 500: 500},
        tuned_steps=(10_000, 2_500),
    ),
    "paper": Scale("what is reported", envs=200, steps=50),
}

STUDY = Study("billiards", PIECES, SCALES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for; return the exit status."""
    return run(STUDY, __doc__ or "", arguments)


if __name__ == "__main__":
    raise SystemExit(main())
