"""Measure what labels add as a prior of the agent's choice, against the same choice without labels.

    python experiments/prior.py --list
    python experiments/prior.py --scale start --out FOLDER                 # before the first step: minutes on two cores
    python experiments/prior.py --out FOLDER --pieces regulation --minutes 9      # on an accelerator; again to go on

Every piece is a sweep with a folder of its own, all in one process, and resumed where it stands: with --minutes the
process saves and ends in time, so that an hour can be had in parts. Last come a table and FOLDER/prior.json, which hold
for each variant the mean over its seeds with its 95% bootstrap interval, which arm acts, and what was paid: labels, and
rewarded steps with those in which arms were validated.

Beside labels stand their controls: `any_aim` (all aims alike), `rule` (written by hand), `shuffled` (labels with each
other's answers), and `none` (the agent alone). `ruled` begins with the rule, which labels correct. `cage` has no arm
but the prior's, `paced` and `papers` are the ways that were there before, `by_value` has a second critic compare.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _pieces import (
    Options,
    Piece,
    Scale,
    asked_of,
    evaluations,
    folder_at,
    list_pieces,
    scaled,
    spread,
    steps_to,
    sweep_command,
    within,
)

from cuelearner_jax.arbiters.prior import ARMS
from cuelearner_jax.cli import main as cuelearner
from cuelearner_jax.storage.provenance import provenance

TASKS = {"regulation": "billiards", "easy": "billiards", "halls": "navigation", "rooms": "navigation"}
METRIC = {"billiards": "reward", "navigation": "success"}
LEVEL = 0.9  # of success, to which steps are counted
SEEDS = 8
FEW, FORMS = (25, 100), ("relative", "demonstration", "scalar")
MILLION: Options = {
    "schedule.total-steps": 1_000_000,
    "schedule.guidance-until": 1_000_000,
    "schedule.eval-every": 50_000,
    "schedule.checkpoint-every": 250_000,
    "agent.replay-capacity": 1_000_000,
}
HALLS: Options = {
    "preset": "paper",
    "schedule.total-steps": 100_000,
    "schedule.guidance-until": 100_000,
    "schedule.eval-every": 10_000,
    "schedule.checkpoint-every": 50_000,
}
SEEN: Options = {"sizes.frame": "action"}
PRIOR: Options = {"arbiter": "prior", "arbiter.judge-steps": 4_000}
# Returns reach 10 and episodes 200 steps; ways lie 5 degrees apart.
PRIOR_OF_WAYS: Options = {
    **PRIOR,
    "arbiter.beta": 1.0,
    "arbiter.trust-after": 20_000,
    "arbiter.near-deg": 5.0,
}
CAGE: Options = {"arbiter.own-share": 0.0, "arbiter.near-share": 0.0}
# Chosen on seeds 0 to 3: of 100 labels one model in long fits forgets the rule (0.634 a shot; so: 0.651).
RULED: Options = {"intent.from-rule": True, "sizes.ensemble": 5, "sizes.fit-steps": 200}
SHUFFLED: Options = {"scalars.answer": "shuffled"}
BRIEF = 0.15  # share of the steps with shaped episodes in `brief`: by then the agent's own choice is the better one


def variants(
    world: str, options: Options, prior: Options, few: tuple[int, ...], many: int, minutes: int
) -> list[Piece]:
    """Labels as a prior in one world, its controls, its ablation, and the other arbiters."""
    shaped, by_value, paced = {**options, **prior}, {**options, "arbiter": "by_value"}, {**options, "arbiter": "paced"}
    budgets, most = (*few, many), few[-1:]
    steps: Any = options["schedule.total-steps"]
    brief = round(BRIEF * steps)
    rows: list[tuple[str, str, tuple[int, ...], Options, str]] = [
        ("alone", "none", (), {**options, "arbiter": "episodes"}, "the agent alone"),
        ("prior", "intent", budgets, shaped, "labels about aims"),
        ("prior", "any_aim", (), shaped, "control: all aims alike"),
        ("prior", "rule", (), shaped, "control: aims by hand"),
        ("shuffled", "intent", budgets[:2], {**shaped, **SHUFFLED}, "control: shuffled answers"),
        *(("prior", kind, most, shaped, f"labels of the form {kind}") for kind in FORMS),
        ("ruled", "intent", budgets, {**shaped, **RULED}, "labels correct the rule"),
        ("ruled_shuffled", "intent", budgets[:2], {**shaped, **RULED, **SHUFFLED}, "control: shuffled answers"),
        ("brief", "intent", most, {**shaped, "schedule.guidance-until": brief}, "labels about aims, for a while"),
        ("cage", "intent", most, {**shaped, **CAGE}, "aims alone"),
        ("cage", "any_aim", (), {**shaped, **CAGE}, "aims alone, without labels"),
        ("by_value", "intent", most, by_value, "a second critic compares"),
        ("by_value", "rule", (), by_value, "a second critic compares, without labels"),
        ("paced", "intent", most, paced, "guidance while it pays"),
    ]
    return [Piece(world, run, kind, (kind,), labels, SEEDS, own, minutes, why) for run, kind, labels, own, why in rows]


REGULATION: Options = {"preset": "regulation", **MILLION}
EASY: Options = {"preset": "easy", **MILLION}
WALKED = {name: {**HALLS, **SEEN, "task.style": style} for name, style in (("halls", "clutter"), ("rooms", "rooms"))}
PAPERS: Options = {**HALLS, "sizes.frame": "raw", "arbiter": "episodes"}
PIECES = (
    *variants("regulation", REGULATION, PRIOR, FEW, 500, 9),
    *variants("easy", EASY, PRIOR, FEW, 500, 9),
    *variants("halls", WALKED["halls"], PRIOR_OF_WAYS, (25, 50), 100, 9),
    Piece("halls", "papers", "relative", ("relative",), (500,), SEEDS, PAPERS, 9, "500 labels in the paper's way"),
    *variants("rooms", WALKED["rooms"], PRIOR_OF_WAYS, (50, 100), 500, 9),
)

TINY: Options = {
    "agent.q-layers": 16,
    "agent.directions": 36,
    "agent.coarse-directions": 0,
    "agent.replay-capacity": 10_000,
    "schedule.total-steps": 100,
    "schedule.eval-every": 100,
    "schedule.checkpoint-every": 100,
}
SCALES = {
    "paper": Scale("what the figures are of"),
    # The agent has learned nothing: its own network has no say, and may be as small as it likes.
    "start": Scale(
        "before the first step of training alone",
        seeds=4,
        labels={25: 25, 50: 50, 100: 100},
        options={**TINY, "schedule.guide-eval-every": 0},
    ),
    "smoke": Scale(
        "seconds a piece on a CPU, to see that everything runs",
        seeds=1,
        labels={25: 10, 50: 15, 100: 20},
        options={
            **TINY,
            "sizes.num-envs": 10,
            "sizes.fit-steps": 20,
            "sizes.feedback-layers": 16,
            "schedule.random-steps": 20,
            "schedule.learn-after": 20,
            "schedule.guidance-until": 100,
            "schedule.guide-eval-every": 0,
            "schedule.eval-steps": 2_000,
            "schedule.eval-envs": 10,
        },
        instead={"arbiter.judge-steps": 200, "arbiter.trust-after": 50},
    ),
}


def rows_of(out: Path, pieces: Sequence[Piece]) -> list[dict[str, Any]]:
    """Return the results of the pieces so far: a row per variant and evaluation, over its seeds."""
    found = []
    for piece, arbiter, row, own in evaluations(out, pieces):
        judged = len(ARMS) * arbiter.get("judge_steps", 0)
        worth = spread([one[METRIC[TASKS[piece.world]]] for one in own])
        told = {**row, **worth, "rewarded_steps": row["step"] + judged}
        if judged:
            told["arms"] = {arm: sum(one["arm"] == number for one in own) for number, arm in enumerate(ARMS)}
            told["judged"] = {arm: float(np.mean([one[f"judged_{arm}"] for one in own])) for arm in ARMS}
        found.append(told)
    return found


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Print a line per variant: start, a tenth and end; in navigation also the steps to the level."""
    groups = defaultdict(list)
    for row in rows:
        groups[row["world"], row["run"], row["guidance"], row["labels"]].append(row)
    lines = [f"{'world':<11}{'run':<10}{'guidance':<14}{'labels':>7}  metric at steps"]
    for (world, run, guidance, labels), own in groups.items():
        last = own[-1]["step"]
        shown = [row for row in own if row["step"] in (0, last // 10, last)]
        cells = [f"{row['step']:>9,}: {row['mean']:.3f} [{row['low']:.3f}, {row['high']:.3f}]" for row in shown]
        if METRIC[TASKS[world]] == "success":
            cells.append(f"{LEVEL:.0%} after {steps_to(LEVEL, own):,.0f}")
        lines.append(f"{world:<11}{run:<10}{guidance:<14}{labels:>7}  " + "  ".join(cells))
    return "\n".join(lines)


def train_pieces(pieces: Sequence[Piece], scale: Scale, out: Path) -> int:
    """Run pieces, each from where it stands; the status of the first that did not end well."""
    for piece in filter(None, (scaled(piece, scale) for piece in pieces)):
        if status := cuelearner(sweep_command(TASKS[piece.world], piece, out, resume=True)):
            return status
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, then tell; returns the exit status, 0 also where the time was up."""
    asked, pieces = asked_of(__doc__ or "", PIECES, SCALES, "prior", arguments)
    if asked.list:
        print(list_pieces(pieces))
        return 0
    out = folder_at(asked.out, asked.scale)
    status = 0 if asked.report else within(asked.minutes, lambda: train_pieces(pieces, SCALES[asked.scale], out))
    if rows := rows_of(out, PIECES):
        told = {**provenance(), "scale": asked.scale, "rows": rows}
        (out / "prior.json").write_text(json.dumps(told, indent=1) + "\n")
        print(table(rows))
    return status


if __name__ == "__main__":
    raise SystemExit(main())
