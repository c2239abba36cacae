"""Arms that learn to reach, push (with and without a post) and pick from scratch, with labels and without.

    python experiments/arms.py --list
    python experiments/arms.py --scale smoke --out FOLDER --resume       # everything in seconds a piece, on a CPU
    python experiments/arms.py --out FOLDER --pieces push --resume       # on an accelerator

A piece is a sweep with a folder of its own. Every method trains the same `sac`. In `stored` each label corrects the
step that is executed, and these steps are half of every minibatch; with demonstrations this is RLPD (Ball et al.,
2023). `rlpd` fits a policy to as many demonstrations; half of all episodes and of every minibatch are that policy's.

Last come a table and FOLDER/arms.json: success of each variant with its 95% interval, how many seeds end above 80%, the
interquartile mean of the step from which a seed stays there, and the ratio of steps to those of the agent alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _pieces import Options, Piece, Scale, asked_of, folder_at, grouped, run_pieces, spread

from cuelearner_jax.errors import UserError
from cuelearner_jax.report import statistics
from cuelearner_jax.storage import results
from cuelearner_jax.storage.provenance import provenance

SEEDS, BUDGETS, LEVEL = 8, (100, 500), 0.8


def steps(total: int, every: int) -> Options:
    """Return options for a number of training steps and an interval between evaluations."""
    return {
        "preset": "paper",
        "schedule.total-steps": total,
        "schedule.guidance-until": total,
        "schedule.eval-every": every,
        "schedule.checkpoint-every": total // 4,
        "agent.replay-capacity": total,
        "arbiter": "episodes",
    }


WORLDS: dict[str, Options] = {
    "reach": {**steps(32_000, 1_600), "task.skill": "reach"},
    "push": {**steps(480_000, 24_000), "task.skill": "push"},
    "push_free": {**steps(480_000, 24_000), "task.skill": "push", "task.obstacle": False},
    "pick": {**steps(480_000, 24_000), "task.skill": "pick"},
}
STORED: Options = {"preset": "corrected"}
RANDOM: Options = {**STORED, "scalars.mistake-probability": 0.5}
ENSEMBLE: Options = {"agent.critics": 10}


def variants(world: str) -> list[Piece]:
    """Return the variants compared in one world."""
    rows: list[tuple[str, str, tuple[int, ...], Options]] = [
        ("alone", "none", (), {}),
        ("alone_10", "none", (), ENSEMBLE),
        ("stored", "relative", BUDGETS, STORED),
        ("stored", "demonstration", BUDGETS, STORED),
        ("stored_random", "relative", (500,), RANDOM),  # control: answers at random
        ("rlpd", "demonstration", BUDGETS, ENSEMBLE),
    ]
    return [
        Piece(world, run, kind, (kind,), labels, SEEDS, {**WORLDS[world], **own}) for run, kind, labels, own in rows
    ]


PIECES = tuple(piece for world in WORLDS for piece in variants(world))
SCALES = {
    "paper": Scale("minutes to hours a piece on an accelerator"),
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
        instead={"agent.critics": 3},
    ),
}


def rows_of(out: Path) -> list[dict[str, Any]]:
    """Return the results of the pieces so far: a row per variant and evaluation, over its seeds."""
    found = []
    for piece in PIECES:
        try:
            rows = results.read(out / piece.path).to_pylist()
        except UserError:  # not begun
            continue
        for (labels, step), own in grouped(rows, "labels", "step"):
            names = {"world": piece.world, "run": piece.run, "guidance": piece.kinds[0], "labels": labels, "step": step}
            each = {row["seed"]: row["success"] for row in own}
            found.append({**names, **spread([*each.values()]), "each": each})
    return found


def reached(rows: Sequence[dict[str, Any]]) -> list[float]:
    """Return the step from which each seed stays at the level or above; inf: the seed ends below."""
    own = [[(row["step"], row["each"][seed]) for row in rows if seed in row["each"]] for seed in rows[0]["each"]]
    curves = (np.array(points, float).T for points in own)
    return [float(statistics.step_at_level(steps, curve, LEVEL)) for steps, curve in curves]


def middle(at: Sequence[float], last: float) -> list[float | None]:
    """Return the interquartile mean of seeds' steps with its 95% interval; None: not known to be below any number."""
    bounds = np.stack([np.minimum(at, last), at], -1)
    ends = statistics.censored_interval(statistics.resampled(bounds[:, None]))
    return [float(step) if np.isfinite(step) else None for step in (statistics.interquartile_mean(at), *ends)]


def compared(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the steps to the level of each variant, and their ratio to those of the agent alone with its 95% interval.

    The ratio is over the steps that both have: a seed that does not get there within these counts with all of them.
    With such seeds among the unguided ones the true ratio is smaller. The interval draws seeds of both, each by itself.
    """
    curves, lines = dict(grouped(rows, "world", "run", "guidance", "labels")), []
    for names, own in curves.items():
        at, alone = reached(own), curves.get((names[0], "alone", "none", 0))
        row = dict(zip(("world", "run", "guidance", "labels"), names, strict=True))
        row |= {"steps": [step if np.isfinite(step) else None for step in at], "reached": int(np.isfinite(at).sum())}
        row["middle"] = middle(at, own[-1]["step"])
        if alone is not None and alone is not own:
            last = min(own[-1]["step"], alone[-1]["step"])
            row["ratio"] = _ratio(np.minimum(at, last), np.minimum(reached(alone), last))
        lines.append({**row, "end": {name: own[-1][name] for name in ("step", "mean", "low", "high")}})
    return lines


def _ratio(steps: np.ndarray, others: np.ndarray) -> list[float]:
    """Return the ratio of the means of two samples, and the ends of its 95% interval."""
    draw = np.random.default_rng(0)
    tops, bottoms = (draw.choice(sample, (2_000, len(sample))).mean(-1) for sample in (steps, others))
    ends = np.quantile(tops / np.maximum(bottoms, 1), (0.025, 0.975))
    return [float(steps.mean() / max(others.mean(), 1)), *ends.tolist()]


def table(lines: Sequence[dict[str, Any]]) -> str:
    """Return a line for each variant."""
    lines_of = [f"{'world':<12}{'run':<15}{'guidance':<15}{'labels':>6}  success at the end; seeds at {LEVEL:.0%}"]
    for row in lines:
        end = row["end"]
        line = f"{row['world']:<12}{row['run']:<15}{row['guidance']:<15}{row['labels']:>6}"
        line += f"  {end['mean']:.3f} [{end['low']:.3f}, {end['high']:.3f}] at {end['step']:,}"
        line += f"; {row['reached']} of {len(row['steps'])}"
        steps = ("never" if step is None else f"{step:,.0f}" for step in row["middle"])
        line += ", from step {} [{}, {}] on".format(*steps)
        if "ratio" in row:
            line += "; {:.2f} [{:.2f}, {:.2f}] of the steps alone".format(*row["ratio"])
        lines_of.append(line)
    return "\n".join(lines_of)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run pieces, then write and print the table; return the exit status."""
    asked, pieces = asked_of(__doc__ or "", PIECES, SCALES, Path("runs/arms"), arguments)
    out = folder_at(asked.out, asked.scale)
    status = 0 if asked.report else run_pieces("arm", pieces, SCALES[asked.scale], out, asked.resume)
    if rows := rows_of(out):
        lines = compared(rows)
        contents = {**provenance(), "scale": asked.scale, "training": rows, "steps": lines}
        (out / "arms.json").write_text(json.dumps(contents, indent=1) + "\n")
        print(table(lines))
    return status


if __name__ == "__main__":
    raise SystemExit(main())
