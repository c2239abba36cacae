"""Arms guided by words: reach, push (with and without a post) and pick, from scratch, in changed worlds, and in Fetch.

    python experiments/arms.py --list
    python experiments/arms.py --scale smoke --out FOLDER                  # everything in seconds a piece, on a CPU
    python experiments/arms.py --out FOLDER --pieces push --minutes 9      # on an accelerator; again to go on

A piece of training is a sweep with a folder of its own, resumed where it stands. Every method trains the same `sac`.
The control is `alone`. `rlpd` fits a policy to as many demonstrations; half of all episodes are that
policy's, and so is half of every minibatch. In `stored` each label corrects the step that is executed, and these steps
are half of every minibatch; with demonstrations this is RLPD (Ball et al., 2023). In `corrections` the agent never
learns: what counts is the guide of uniform actions. Worlds `reach_in_fetch` and `push_in_fetch` train in Fetch itself.

A piece of adaptation corrects a script, or in Fetch a trained agent, by labels. Held-out labels judge: no step is
rewarded. Demonstrations and good/bad labels cannot judge: 20 tuning episodes do, and their steps are counted. A piece
is done once `measured.json` lies in its folder.

Last come a table and FOLDER/arms.json: labels and rewarded steps of each variant, success with its 95% interval, how
many seeds reach 80%, their median step, and the ratio of steps to those of the agent alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _arms_adaptation import CORRECTED, Corrected, commands, measured
from _pieces import (
    Options,
    Piece,
    Scale,
    asked_of,
    evaluations,
    folder_at,
    grouped,
    list_pieces,
    scaled,
    spread,
    steps_to,
    sweep_command,
    within,
)

from cuelearner_jax.cli import main as cuelearner
from cuelearner_jax.errors import UserError
from cuelearner_jax.storage import results
from cuelearner_jax.storage.provenance import provenance

TASK = "arm"
SEEDS, BUDGETS, LEVEL = 8, (100, 500), 0.8
FORMS = ("relative", "demonstration", "scalar", "dcoach")
PEERS = ("bdcoach", "clic")


def steps(total: int, every: int) -> Options:
    """Return options for a number of training steps and an interval between evaluations."""
    return {
        "preset": "paper",
        "schedule.total-steps": total,
        "schedule.guidance-until": total,
        "schedule.eval-every": every,
        "schedule.checkpoint-every": total // 4,
        "agent.replay-capacity": total,
    }


WORLDS: dict[str, Options] = {
    "reach": {**steps(32_000, 1_600), "task.skill": "reach"},
    "push": {**steps(480_000, 24_000), "task.skill": "push"},
    "push_free": {**steps(480_000, 24_000), "task.skill": "push", "task.obstacle": False},
    "pick": {**steps(480_000, 24_000), "task.skill": "pick"},
}
# Fetch steps in processes on the host, so evaluations are short there. Guides, which never act there, are small.
IN_FETCH: Options = {
    "robot": "fetch",
    "schedule.eval-steps": 1_000,
    "schedule.eval-envs": 20,
    "sizes.feedback-layers": (64, 64),
    "sizes.fit-steps": 400,
}
FETCH_WORLDS: dict[str, Options] = {
    "reach_in_fetch": {**steps(9_600, 800), "task.skill": "reach", **IN_FETCH},
    "push_in_fetch": {**steps(480_000, 24_000), "task.skill": "push", **IN_FETCH},
}
PLAIN_RUNS = ("alone", "stored", "stored_random")  # without a guide whose every action is refined
EPISODES: Options = {"arbiter": "episodes"}
ENSEMBLE: Options = {"agent.critics": 10}
STORED: Options = {"preset": "corrected"}
# The agent only ever acts at random. Half of the episodes are guided, as questions are then asked there too.
UNLEARNED: Options = {
    "arbiter": "episodes",
    "schedule.total-steps": 16_000,
    "schedule.learn-after": 16_000,
    "schedule.guidance-until": 16_000,
    "schedule.eval-every": 16_000,
    "schedule.checkpoint-every": 16_000,
    "schedule.guide-eval-every": 50,
}
WRONG: Options = {"scalars.mistake-probability": 0.2}
RANDOM: Options = {"scalars.mistake-probability": 0.5}
ONE: Options = {"scalars.says": "one"}


def variants(world: str, options: Options) -> list[Piece]:
    """Return the variants compared in one world."""
    minutes = 3 if world.startswith("reach") else 9
    plain, alone = {**options, **EPISODES}, {**options, **UNLEARNED}
    stored = {**options, **STORED}
    rows: list[tuple[str, str, tuple[int, ...], Options, str]] = [
        ("alone", "none", (), plain, "SAC alone"),
        ("alone_10", "none", (), {**plain, **ENSEMBLE}, "SAC alone, ten critics"),
        ("rlpd", "demonstration", BUDGETS, {**plain, **ENSEMBLE}, "a policy of them in the replay"),
        *(("stored", kind, BUDGETS, stored, "corrected steps in the replay") for kind in ("relative", "demonstration")),
        ("stored_random", "relative", (500,), {**stored, **RANDOM}, "control: answers at random in the replay"),
        *(("corrections", kind, (500,), alone, "labels alone") for kind in (*FORMS, *PEERS)),
        ("wrong", "relative", (500,), {**alone, **WRONG}, "labels alone, a fifth wrong"),
        ("one_cue", "relative", (500,), {**alone, **ONE}, "labels alone, one cue each"),
    ]
    return [Piece(world, run, kind, (kind,), labels, SEEDS, own, minutes, why) for run, kind, labels, own, why in rows]


TRAINED = (
    *(piece for world, options in WORLDS.items() for piece in variants(world, options)),
    *(
        piece
        for world, options in FETCH_WORLDS.items()
        for piece in variants(world, options)
        if piece.run in PLAIN_RUNS
    ),
)
PIECES = (*TRAINED, *CORRECTED)

SMALL: Options = {
    "agent.actor-layers": (64, 64),
    "agent.critic-layers": (64, 64),
    "agent.batch-size": 128,
    "schedule.eval-steps": 1_000,
    "schedule.eval-envs": 20,
}
SCALES = {
    "paper": Scale("what the figures are of"),
    "quick": Scale(
        "minutes a piece on a CPU: small networks, two seeds, 100 labels",
        seeds=2,
        labels={100: 100, 500: 500},
        options={
            **SMALL,
            "schedule.total-steps": 16_000,
            "schedule.guidance-until": 16_000,
            "schedule.eval-every": 1_600,
            "schedule.checkpoint-every": 16_000,
            "agent.replay-capacity": 16_000,
            "sizes.feedback-layers": (64, 64),
            "sizes.fit-steps": 400,
        },
    ),
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        seeds=1,
        labels={100: 10, 500: 20},
        options={
            "agent.actor-layers": 8,
            "agent.critic-layers": 8,
            "agent.batch-size": 8,
            "agent.replay-capacity": 160,
            "sizes.fit-steps": 20,
            "sizes.feedback-layers": 8,
            "schedule.total-steps": 160,
            "schedule.guidance-until": 160,
            "schedule.random-steps": 32,
            "schedule.learn-after": 32,
            "schedule.eval-every": 160,
            "schedule.checkpoint-every": 160,
            "schedule.eval-steps": 100,
            "schedule.eval-envs": 2,
        },
        instead={"agent.critics": 3, "schedule.guide-eval-every": 10},
    ),
}


def rows_of(out: Path, pieces: Sequence[Piece]) -> list[dict[str, Any]]:
    """Return the results of the trained pieces so far: a row per variant and evaluation, over its seeds."""
    found = []
    for piece, _, row, own in evaluations(out, pieces):
        paid = row["step"] + (row["labels"] if piece.options["preset"] == "corrected" else 0)
        told = {**row, **spread([one["success"] for one in own]), "rewarded_steps": paid}
        found.append({**told, "each": {one["seed"]: one["success"] for one in own}})
    return found


def guides_of(out: Path, pieces: Sequence[Piece]) -> list[dict[str, Any]]:
    """Success of uniform actions under the guides of `corrections` and its like, over the labels asked for."""
    found = []
    for piece in pieces:
        try:
            table = results.read_guides([out / piece.path])
        except UserError:  # the first guide is not measured yet
            continue
        for (budget, asked), own in grouped(table.to_pylist() if table else [], "labels", "asked"):
            row = {"world": piece.world, "run": piece.run, "guidance": piece.kinds[0], "budget": budget}
            found.append({**row, "labels": asked, **spread([one["guide_success"] for one in own])})
    return found


def reached(rows: Sequence[dict[str, Any]]) -> list[float]:
    """Steps after which each seed's own curve reaches the level; inf: never."""
    seeds = rows[0]["each"]
    curves = [
        [{"step": row["step"], "mean": row["each"][seed]} for row in rows if seed in row["each"]] for seed in seeds
    ]
    return [steps_to(LEVEL, curve) for curve in curves]


def compared(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Steps to the level for each variant, and their ratio to those of the agent alone with its 95% interval.

    The ratio is over the steps that both have: a seed that does not get there within these counts with all of them.
    With such seeds among the unguided ones the true ratio is smaller. The interval draws seeds of both, each by itself.
    """
    found, lines = dict(grouped(rows, "world", "run", "guidance", "labels")), []
    for names, own in found.items():
        at, alone = reached(own), found.get((names[0], "alone", "none", 0))
        row = dict(zip(("world", "run", "guidance", "labels"), names, strict=True))
        row |= {"steps": [step if np.isfinite(step) else None for step in at], "reached": int(np.isfinite(at).sum())}
        row["median"] = float(np.median(at)) if np.isfinite(np.median(at)) else None
        if alone is not None and alone is not own:
            last = min(own[-1]["step"], alone[-1]["step"])
            row["ratio"] = _ratio(np.minimum(at, last), np.minimum(reached(alone), last))
        end = {name: own[-1][name] for name in ("step", "rewarded_steps", "mean", "low", "high")}
        lines.append({**row, "end": end})
    return lines


def _ratio(steps: np.ndarray, others: np.ndarray) -> list[float]:
    """Ratio of the means of two samples, and the ends of its 95% interval."""
    draw = np.random.default_rng(0)
    tops, bottoms = (draw.choice(sample, (2_000, len(sample))).mean(-1) for sample in (steps, others))
    ends = np.quantile(tops / np.maximum(bottoms, 1), (0.025, 0.975))
    return [float(steps.mean() / max(others.mean(), 1)), *ends.tolist()]


def table(steps: Sequence[dict[str, Any]], guides: Sequence[dict[str, Any]], shown: Sequence[dict[str, Any]]) -> str:
    """A line for each variant of training, each guide of all its labels, and each adaptation."""
    lines = [f"{'world':<16}{'run':<15}{'guidance':<15}{'labels':>6}  success at the end; seeds at {LEVEL:.0%}"]
    for row in steps:
        told = f" at {row['end']['step']:,}; {row['reached']} of {len(row['steps'])}"
        told += "" if row["median"] is None else f", median step {row['median']:,.0f}"
        if "ratio" in row:
            told += "; {:.2f} [{:.2f}, {:.2f}] of the steps alone".format(*row["ratio"])
        lines.append(_line({**row, **row["end"]}) + told)
    lines += [_line(row) + " of the guide alone" for row in guides if row["labels"] == row["budget"]]
    return "\n".join([*lines, *map(_line, shown)])


def _line(row: dict[str, Any]) -> str:
    names = f"{row['world']:<16}{row['run']:<15}{row['guidance']:<15}{row['labels']:>6}"
    return f"{names}  {row['mean']:.3f} [{row['low']:.3f}, {row['high']:.3f}]"


def count_done(pieces: Sequence[Piece | Corrected], scale: str, out: Path) -> int:
    """Run pieces, each from where it stands; the status of the first that did not end well."""
    for piece in pieces:
        if isinstance(piece, Corrected):
            orders = commands(piece, out, scale)
        else:
            left = scaled(piece, SCALES[scale])
            orders = [] if left is None else [sweep_command(TASK, left, out, resume=True)]
        for order in orders:
            if status := cuelearner(order):
                return status
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, then tell; returns the exit status, 0 also where the time was up."""
    asked, pieces = asked_of(__doc__ or "", PIECES, SCALES, "arms", arguments)
    if asked.list:
        print(list_pieces(pieces))
        return 0
    out = folder_at(asked.out, asked.scale)
    status = 0 if asked.report else within(asked.minutes, lambda: count_done(pieces, asked.scale, out))
    rows, guides, shown = rows_of(out, TRAINED), guides_of(out, TRAINED), measured(out, CORRECTED)
    if rows or shown:
        steps_taken = compared(rows)
        told = {**provenance(), "scale": asked.scale, "training": rows, "steps": steps_taken}
        told |= {"guides": guides, "adaptation": shown}
        (out / "arms.json").write_text(json.dumps(told, indent=1) + "\n")
        print(table(steps_taken, guides, shown))
    return status


if __name__ == "__main__":
    raise SystemExit(main())
