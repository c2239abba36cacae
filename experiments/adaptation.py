"""Adapt trained agents of billiards and navigation in changed worlds, and measure them before and after.

    python experiments/adaptation.py --list
    python experiments/adaptation.py --out FOLDER [--pieces navigation/bases navigation/rooms] [--resume]

The piece `bases` of a task trains its base agents; a run of your own may lie in FOLDER/navigation/bases/none instead.
Every other piece is what a user types: `cuelearner adapt` with the scenario's recipe, then `cuelearner evaluate` beside
the base agents. Pieces without labels measure the base agents, or the teacher. Each has a JSON file of measurements.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import billiards_bootstrapping
import navigation_bootstrapping
from _pieces import Experiment, Options, Piece, Scale, run, sweep_command, words_of

BASES, UNCHANGED = "bases", "unchanged"  # the training of base agents, and the world that they were trained in
SHUFFLED: Options = {"scalars.answer": "shuffled"}
# Relative labels of a teacher who intends the good shot nearest to the agent's.
NEAREST: Options = {
    "task.teacher": "local_search",
    "scalars.answer": "nearest",
    "scalars.nearest-aim-deg": 0.1,
    "scalars.nearest-share": 0.9,
    "scalars.feedback-learning-rate": 3e-4,
}
LIDAR: Options = {"sizes.frame": "action", "bound-deg": 60.0, "judge-by": "success"}
WIDE: Options = {"sizes.frame": "action", "scalars.eps-deg": 20.0}  # in rooms small turns lead nowhere
MANY: dict[str, Options] = {  # episodes, or steps, of a measurement
    "billiards": {"envs": 200, "steps": 10_000},
    "navigation": {"episodes": 2_000},
}
FEW: dict[str, Options] = {"billiards": {"envs": 4, "steps": 12}, "navigation": {"episodes": 4}}  # at the scale `smoke`
TRAINING = {"billiards": billiards_bootstrapping, "navigation": navigation_bootstrapping}


def pieces(task: str, world: str, *rows: tuple[str, str, tuple[int, ...], Options]) -> list[Piece]:
    """Return the pieces of a world: its base agents, its teacher, and (name, guidance, budgets, options) of others."""
    plain = [("none", "agent", (), {}), ("teacher", "teacher", (), {})]
    return [Piece(task, world, name, (kind,), labels, 1, options) for name, kind, labels, options in [*plain, *rows]]


def billiards(world: str, more: Options) -> list[Piece]:
    """Return the pieces of billiards in a world; in the unchanged one they show whether a method does harm."""
    return pieces(
        "billiards",
        world,
        ("relative", "relative", (50, 100, 250), {**NEAREST, **more}),
        ("relative-shuffled", "relative", (50, 100, 250), {**NEAREST, **more, **SHUFFLED}),
        ("reading", "reading", (50, 100), {}),
    )


def lidar(world: str) -> list[Piece]:
    """Return the pieces of the turned lidar, or of no change as its control."""
    return pieces(
        "navigation",
        world,
        ("relative", "relative", (50, 100, 250), LIDAR),
        ("relative-shuffled", "relative", (50, 100, 250), {**LIDAR, **SHUFFLED}),
        ("reading", "reading", (50, 250), {}),
    )


def ways(world: str, *rows: tuple[str, str, tuple[int, ...], Options]) -> list[Piece]:
    """Return the pieces of a world where a way has to be chosen."""
    return pieces(
        "navigation",
        world,
        ("relative", "relative", (250, 1_000), WIDE),
        ("intent", "intent", (100, 250, 1_000), {}),
        ("intent-shuffled", "intent", (250, 1_000), SHUFFLED),
        *rows,
    )


def legs(world: str, judge_by: str) -> list[Piece]:
    """Return the pieces of the simple robot's agents on the quadruped."""
    options = {**WIDE, "robot": "anymal", "bound-deg": 60.0, "judge-by": judge_by}
    every = pieces("navigation", world, ("relative", "relative", (100, 250, 500), options))
    return [one._replace(name=f"anymal-{one.name}", options={"robot": "anymal", **one.options}) for one in every]


PIECES = (
    Piece("billiards", BASES, "none", ("none",), (), 8, {"preset": "regulation"}),
    *billiards(UNCHANGED, {"bound-deg": 1.0, "scalars.eps-deg": 0.1}),
    *(piece for world in ("turned_strike", "shifted_balls", "tilted_table") for piece in billiards(world, {})),
    Piece("navigation", BASES, "none", ("none",), (), 8, {"preset": "paper"}),
    *lidar(UNCHANGED),
    *lidar("turned_lidar"),
    *ways("rooms", ("intent-near", "intent", (250, 1_000), {"task.look-ahead": False})),
    *ways("corridor_left"),
    *ways("corridor_right"),
    *legs(UNCHANGED, "success"),
    *legs("corridor_left", "passed_left"),
)
SCALES = {
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        seeds=2,
        labels={50: 20, 250: 25},  # a reading asks for at least 20
        options={
            "sizes.feedback-layers": 16,
            "sizes.labels-per-round": 5,
            "sizes.fit-steps": 20,
            "sizes.fit-batch-size": 5,
            "judge-episodes": 4,
        },
    ),
    "cpu": Scale(
        "ten minutes a piece on 2 cores: small models",
        options={"sizes.feedback-layers": (128, 128), "sizes.fit-steps": 400, "sizes.fit-batch-size": 64},
    ),
    "paper": Scale("minutes a piece on an accelerator; base agents hours"),
}


def commands(_: str, piece: Piece, out: Path, resume: bool) -> list[list[str]]:
    """Return the command lines of a piece that are still to be run."""
    task, own, folder = piece.world, dict(piece.options), out / piece.path
    is_smoke = "judge-episodes" in own
    if piece.run == BASES:
        own = {"preset": own["preset"], **(TRAINING[task].SCALES["smoke"].options if is_smoke else {})}
        return [sweep_command(task, piece._replace(options=own), out, resume)]
    agents, result = out / task / BASES / "none", folder.with_suffix(".json")
    if resume and result.exists():
        return []
    world = [] if piece.run == UNCHANGED else ["--scenario", piece.run]
    robot = words_of({"robot": own.pop("robot")} if "robot" in own else {})
    measure = [*words_of(FEW[task] if is_smoke else MANY[task]), "--out", str(result)]
    if not piece.labels:
        return [["evaluate", str(agents), "--policy", *piece.kinds, *world, *robot, *measure]]
    seeds = tuple(json.loads((agents / "config.json").read_text())["grid"]["seeds"])
    ask = words_of({"base.seed": seeds, "guidance": piece.kinds, "labels": piece.labels, **own})
    adapt = ["adapt", str(agents), *ask, *world, *robot, "--out", str(folder), *(["--overwrite"] if resume else [])]
    return [adapt, ["evaluate", str(folder), "--compare", "base", *robot, *measure]]


EXPERIMENT = Experiment("adaptation", PIECES, SCALES, commands=commands)
main = partial(run, EXPERIMENT, __doc__ or "")


if __name__ == "__main__":
    raise SystemExit(main())
