"""Number of corrections a policy needs without any reward: seven kinds, four worlds, three teachers.

    python experiments/corrections_alone.py --list
    python experiments/corrections_alone.py --scale quick --out runs/corrections [--pieces halls grasp/clic] [--resume]
    python experiments/corrections_alone.py --tuning --scale quick --out runs/corrections_tuning
    python experiments/corrections_page.py --data runs/corrections

A piece is one kind in one world, with all its teachers (plain; wrong with a probability of 20%; one cue a label), label
seeds and budgets. Controls: `base`, the policy before any label, and labels that have each other's answers. In `halls`,
`grasp` and `reach` a policy is learned from nothing; in `turned` and `displaced` a script of the arm is corrected whose
camera has moved. `--tuning` compares four settings of each kind with 100 labels of other seeds, on other episodes
(250 in `reach`): CHOSEN below are the best of these. OUT/WORLD/KIND.json grows as it is measured.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _corrections import (
    CONDITIONS,
    FIRST_SEED,
    Opened,
    Row,
    Settings,
    World,
    arm,
    grasp,
    halls,
    measure,
    read,
    without_labels,
)

from cuelearner_jax.errors import UserError
from cuelearner_jax.storage.provenance import provenance

WORLDS: Mapping[str, World] = {
    world.name: world
    for world in (
        World("halls", "navigation among obstacles, learned from nothing", halls),
        World("grasp", "a grasp in a box of three cues, learned from nothing", grasp),
        World("reach", "the arm's gripper to a goal, learned from nothing", arm("reach")),
        World("turned", "the arm's script of reach, its camera turned", arm("reach", "turned_camera"), adapts=True),
        World(
            "displaced",
            "the arm's script of push, its camera 2 cm aside",
            arm("push", "hand_eye", episodes_each=2),
            adapts=True,
            tuned_in="turned",
        ),
    )
}
RELATIVE_KINDS = ("relative", "dcoach", "bdcoach", "clic")
LEARNED = (*RELATIVE_KINDS, "demonstration", "scalar", "clic_shown")
ADAPTED = ("reading", *RELATIVE_KINDS, "demonstration", "scalar")
KINDS: Mapping[str, tuple[str, ...]] = {
    name: ("base", *(ADAPTED if world.adapts else LEARNED)) for name, world in WORLDS.items()
}
PIECES = tuple(f"{world}/{kind}" for world, kinds in KINDS.items() for kind in kinds)
MOST_READ = 100  # labels, by one lane after another
TUNED_LABELS = {"reach": 250}  # where no kind does anything with 100, the number elsewhere

RATES = {"scalars.feedback_learning_rate": (1e-3, 3e-3)}
EPS = {"halls": (20.0, 40.0), "grasp": (0.1, 0.2), "reach": (0.05, 0.2), "turned": (0.05, 0.1)}
WITHIN = {"halls": (20.0, 40.0), "grasp": (0.1, 0.2), "reach": (0.1, 0.2), "turned": (0.05, 0.1)}
FITTED = ("reach", "turned")  # worlds in which more fitting is tried as well
FITTING = {"dcoach": {"replay_steps": (5, 15)}, "bdcoach": {"batch_steps": (5, 15)}}  # for each label


def settings_of(world: str, kind: str) -> list[dict[str, Any]]:
    """Return the settings of a kind that are compared in a world.

    Four: two step sizes, and two of what matters most beside. In the arm eight: also with three times as much fitting.
    """
    second: dict[str, tuple[Any, ...]] = {"scalars.eps_deg": EPS[world]}
    if kind == "scalar":
        second = {"scalars.scalar_within_deg": WITHIN[world]}
    if kind == "demonstration":
        second = {"sizes.fit_batch_size": (32, 128)} if world in FITTED else {"sizes.fit_steps": (300, 600)}
    if kind == "clic_shown":
        second = {"radius": (0.5, 0.1)}
    if world in FITTED:
        second |= FITTING.get(kind, {"sizes.fit_steps": (300, 900)})
    grid = {**RATES, **second}
    found = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    return [{**FRAMES.get(world, {}), **one} for one in found]


FRAMES: Mapping[str, dict[str, Any]] = {"halls": {"sizes.frame": "action"}}  # as the adaptation studies found best
SLOW, FAST = ({"scalars.feedback_learning_rate": rate} for rate in (1e-3, 3e-3))
IN_HALLS = FRAMES["halls"]
CHOSEN: Mapping[str, Mapping[str, Settings]] = {
    "halls": {
        "relative": {**IN_HALLS, **FAST, "scalars.eps_deg": 20.0},
        "dcoach": {**IN_HALLS, **SLOW, "scalars.eps_deg": 40.0},
        "bdcoach": {**IN_HALLS, **FAST, "scalars.eps_deg": 40.0},
        "clic": {**IN_HALLS, **SLOW, "scalars.eps_deg": 40.0},
        "demonstration": {**IN_HALLS, **FAST, "sizes.fit_steps": 600},
        "scalar": {**IN_HALLS, **SLOW, "scalars.scalar_within_deg": 20.0},
    },
    "grasp": {
        "relative": {**FAST, "scalars.eps_deg": 0.1},
        "dcoach": {**FAST, "scalars.eps_deg": 0.2},
        "bdcoach": {**SLOW, "scalars.eps_deg": 0.1},
        "clic": {**SLOW, "scalars.eps_deg": 0.1},
        "demonstration": {**FAST, "sizes.fit_steps": 600},
        "scalar": {**SLOW, "scalars.scalar_within_deg": 0.2},
        "clic_shown": {**FAST, "radius": 0.1},
    },
    "reach": {
        "relative": {**FAST, "scalars.eps_deg": 0.2, "sizes.fit_steps": 900},
        "dcoach": {**FAST, "scalars.eps_deg": 0.2, "replay_steps": 5},
        "bdcoach": {**SLOW, "scalars.eps_deg": 0.2, "batch_steps": 15},
        "clic": {**FAST, "scalars.eps_deg": 0.05, "sizes.fit_steps": 900},
        "demonstration": {**SLOW, "sizes.fit_batch_size": 128, "sizes.fit_steps": 900},
        "scalar": {**SLOW, "scalars.scalar_within_deg": 0.2, "sizes.fit_steps": 900},
        "clic_shown": {**FAST, "radius": 0.5, "sizes.fit_steps": 300},
    },
    # No setting of deep COACH reached a goal there: its first.
    "turned": {
        "relative": {**SLOW, "scalars.eps_deg": 0.05, "sizes.fit_steps": 900},
        "dcoach": {**SLOW, "scalars.eps_deg": 0.05, "replay_steps": 5},
        "bdcoach": {**SLOW, "scalars.eps_deg": 0.05, "batch_steps": 5},
        "clic": {**SLOW, "scalars.eps_deg": 0.1, "sizes.fit_steps": 300},
        "demonstration": {**SLOW, "sizes.fit_batch_size": 32, "sizes.fit_steps": 900},
        "scalar": {**SLOW, "scalars.scalar_within_deg": 0.1, "sizes.fit_steps": 300},
    },
}


class Scale(NamedTuple):
    """How much is asked and played."""

    about: str
    budgets: tuple[int, ...]
    seeds: int  # of labels
    episodes: int
    settings: Settings | None = None  # of the networks


TINY = {"sizes.feedback_layers": (8,), "sizes.fit_steps": 20, "sizes.fit_batch_size": 8}
SCALES = {
    "smoke": Scale("seconds a piece", (25,), 1, 2, TINY),
    "quick": Scale("minutes a piece on one core", (25, 100, 250), 4, 25),
    "paper": Scale("what is reported: minutes a piece on one core", (25, 100, 250, 500), 8, 25),
}


@cache
def open_world(world: str, split: str) -> Opened:
    """A world that is ready, made once."""
    return WORLDS[world].opened(split)


def runs_of(piece: str, scale: Scale, tuning: bool, known: set[tuple[Any, ...]]) -> Iterator[list[Row]]:
    """The rows of a piece, a list a run, but for conditions that are known."""
    world, kind = piece.split("/")
    split = "tuning" if tuning else "validation"
    seeds, opened = [FIRST_SEED[split] + number for number in range(scale.seeds)], open_world(world, split)
    if kind == "base":
        if not known:
            yield without_labels(opened, seeds, scale.episodes)
        return
    conditions = [one for one in CONDITIONS if (one.name,) not in known]
    if kind == "reading":
        for condition in (one for one in conditions if one.name != "shuffled"):  # which asks by what was answered
            budgets = [labels for labels in scale.budgets if labels <= MOST_READ]
            yield read(opened, condition, seeds, budgets, scale.episodes)
        return
    place = WORLDS[world], opened, kind
    if not tuning:
        settings = {**CHOSEN.get(WORLDS[world].tuned_in or world, {}).get(kind, {}), **(scale.settings or {})}
        yield from measure(*place, settings, conditions, seeds, scale.budgets, scale.episodes, max(scale.budgets))
        return
    budgets = (min(TUNED_LABELS.get(world, 100), max(scale.budgets)),)
    for settings in settings_of(world, kind):
        tried = {**settings, **(scale.settings or {})}
        for rows in measure(*place, tried, CONDITIONS[:1], seeds, budgets, scale.episodes, max(scale.budgets)):
            yield [{**row, "settings": settings} for row in rows]


def whole(rows: Sequence[Row], seeds: int) -> list[Row]:
    """The rows of conditions that were measured with all seeds and budgets: others are measured anew."""
    kept = []
    for condition in dict.fromkeys(row["condition"] for row in rows):
        own = [row for row in rows if row["condition"] == condition]
        if len(own) == seeds * len({row["labels"] for row in own}):
            kept += own
    return kept


def run(piece: str, scale: str, tuning: bool, out: Path, resume: bool) -> None:
    """Measure a piece and write after each run. Raises UserError for a file that is there and is not gone on with."""
    file, rows = out / f"{piece}.json", []
    if file.exists():
        if not resume:
            raise UserError(f"{file} exists: give another --out, or --resume")
        found = json.loads(file.read_text())
        if (found["scale"], found["tuning"]) != (scale, tuning):
            raise UserError(f"{file} is of the scale {found['scale']}, tuning {found['tuning']}: give another --out")
        if found["finished"]:
            return
        rows = [] if tuning else whole(found["rows"], SCALES[scale].seeds)
    command = f"corrections_alone.py --scale {scale} {'--tuning ' if tuning else ''}--pieces {piece}"
    about = {"scale": scale, "tuning": tuning, **provenance(), "command": command}

    def write(finished: bool, seconds: float) -> None:
        lines = ",\n".join("  " + json.dumps(row) for row in rows)
        head = json.dumps({**about, "finished": finished, "seconds": round(seconds), "rows": []}, indent=1)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(head.replace('"rows": []', f'"rows": [\n{lines}\n ]') + "\n")

    begun, known = time.monotonic(), {(row["condition"],) for row in rows}
    for new in runs_of(piece, SCALES[scale], tuning, known):
        rows += new
        write(False, time.monotonic() - begun)
        for key in dict.fromkeys((row["condition"], row["labels"]) for row in new):
            values = [row["success"] for row in new if (row["condition"], row["labels"]) == key]
            told = {**new[0].get("settings", {})}
            spent = time.monotonic() - begun
            print(f"{piece} {key[0]} {key[1]}: {np.mean(values):.3f} {told or ''} ({spent:.0f} s)", flush=True)
    write(True, time.monotonic() - begun)


def chosen(names: Sequence[str], tuning: bool) -> list[str]:
    """The pieces of these names, or of these worlds; all of them for no name. Raises UserError for another name."""
    for name in names:
        if not any(f"{piece}/".startswith(f"{name}/") for piece in PIECES):
            raise UserError(f"no piece {name!r}: see --list")
    found = [piece for piece in PIECES if not names or any(f"{piece}/".startswith(f"{name}/") for name in names)]
    if not tuning:
        return found
    return [one for one in found if not one.endswith(("/base", "/reading")) and one.split("/")[0] in EPS]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure pieces."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    told = "; ".join(f"{name}: {scale.about}" for name, scale in SCALES.items())
    parser.add_argument("--scale", choices=list(SCALES), default="paper", help=told)
    parser.add_argument("--tuning", action="store_true", help="compare settings on other seeds and episodes")
    parser.add_argument(
        "--pieces", nargs="+", default=[], metavar="NAME", help="these, or all of a world; default: all"
    )
    parser.add_argument("--list", action="store_true", help="name the pieces and leave")
    parser.add_argument("--out", type=Path, default=Path("runs/corrections"), help="folder")
    parser.add_argument("--resume", action="store_true", help="keep what OUT has")
    given = parser.parse_args(arguments)
    if given.list:
        print("\n".join(PIECES))
        return 0
    try:
        for piece in chosen(given.pieces, given.tuning):
            run(piece, given.scale, given.tuning, given.out, given.resume)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ninterrupted: --resume goes on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
