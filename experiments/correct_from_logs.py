"""A policy in NumPy, wrong by a constant in a box of three entries, corrected from recorded situations alone.

    python experiments/correct_from_logs.py --out docs/data/correct_from_logs.csv

200 simulated answers of all cues about recorded situations: in rounds, about actions refined by the model so far, as
the labelling page asks; or about the policy's actions moved at random within the bound, all at once. Judged on
situations that were not recorded. The control has each label answered by another label's answer. A few minutes on 2
cores.
"""

from __future__ import annotations

import csv
import dataclasses
import tempfile
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import cuelearner_jax as cl
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.feedback.answers import relative_feedback
from cuelearner_jax.spaces import Box
from cuelearner_jax.tasks import logs

LOW, HIGH = (-0.1, -0.1, -1.0), (0.1, 0.1, 1.0)  # [m, m, 1]: two directions of a tool, and its fingers
OFFSET = np.array([0.02, -0.015, 0.2], np.float32)
BOX = Box(LOW, HIGH)
RANGE = np.array(HIGH) - np.array(LOW)
BOUND = 0.25  # shares of the ranges
LABELS, RECORDED, OTHERS = 200, 400, 2000


def intended_actions(obs):
    """Return the teacher's intended actions."""
    return np.stack([0.06 * obs[:, 0], 0.06 * obs[:, 1], 0.6 * np.tanh(obs[:, 2] * obs[:, 0])], -1).astype(np.float32)


def off(obs):
    """The policy: the same, wrong by a constant."""
    return intended_actions(obs) + OFFSET


class Row(NamedTuple):
    """Result of one correction."""

    guidance: str
    questions: str  # "rounds" or "at random"
    answers: str  # "own" or "shuffled"
    seed: int
    before: float  # mean distance from what is wanted, in shares of the ranges
    after: float
    used: bool

    @property
    def left(self) -> float:
        """Share of the error that is left."""
        return self.after / self.before


def error(policy, seed: int) -> float:
    """Mean distance from what is wanted, in shares of the ranges, in situations that were not recorded."""
    obs = np.random.default_rng((seed, 1)).uniform(-1, 1, (OTHERS, 3)).astype(np.float32)
    return float((np.abs(policy(obs) - intended_actions(obs)) / RANGE).mean())


def recorded(seed: int) -> np.ndarray:
    """Observations of the recorded situations."""
    return np.random.default_rng((seed, 0)).uniform(-1, 1, (RECORDED, 3)).astype(np.float32)


def at_random(seed: int, eps: float, is_shuffled: bool) -> cl.Labels:
    """Answers about the policy's actions, moved at random by up to the bound; shuffled: each that of another label."""
    random = np.random.default_rng((seed, 2))
    obs = random.permutation(recorded(seed))[:LABELS]
    moved = off(obs) + BOUND * RANGE * random.uniform(-1, 1, obs.shape)
    actions = np.clip(moved, LOW, HIGH).astype(np.float32)
    answer = jax.vmap(lambda action, best: relative_feedback(BOX, action, best, eps))
    answers = np.array(answer(jnp.asarray(actions), jnp.asarray(intended_actions(obs))))
    return cl.Labels(obs, actions, np.random.default_rng((seed, 3)).permutation(answers) if is_shuffled else answers)


def in_rounds(seed: int, guidance: str, folder: Path, control: bool):
    """The policy corrected while the questions are asked."""
    folder.mkdir(exist_ok=True)
    np.savez(folder / "situations.npz", observation=recorded(seed), action=np.clip(off(recorded(seed)), LOW, HIGH))
    task = logs.task_of(folder, low=LOW, high=HIGH)
    scalars = None
    if control and guidance != "reading":
        scalars = dataclasses.replace(plain_scalars(BOX), answer="shuffled")
    bound = None if guidance == "reading" else BOUND
    how: dict[str, Any] = {"labels": LABELS, "guidance": guidance, "judge_by": "labels", "seed": seed}
    return cl.adapt(off, cl.World(task, task.plain()), intended_actions, bound_deg=bound, scalars=scalars, **how)


def correct(guidance: str, questions: str, answers: str, seed: int, folder: Path) -> Row:
    """Correct a policy once and judge it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a control is not used
        if questions == "rounds":
            found = in_rounds(seed, guidance, folder, answers == "shuffled")
        else:
            eps = plain_scalars(BOX).eps_deg
            labels = at_random(seed, eps, answers == "shuffled")
            bound = None if guidance == "reading" else BOUND
            found = cl.correct(off, labels, low=LOW, high=HIGH, eps=eps, guidance=guidance, seed=seed, bound=bound)
    return Row(guidance, questions, answers, seed, error(off, seed), error(found, seed), found.used)


def main(seeds: int = 5, out: Path | None = None) -> list[Row]:
    """Run all corrections.

    Args:
        seeds: of situations, questions and fits.
        out: a CSV file of one row a correction.
    """
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for guidance in ("relative", "reading"):
            for questions in ("rounds", "at random"):
                for answers in ("own", "shuffled"):
                    if (guidance, questions, answers) == ("reading", "rounds", "shuffled"):
                        continue  # calibration asks by what was answered: there is nothing to shuffle beforehand
                    own = [correct(guidance, questions, answers, seed, Path(folder) / "there") for seed in range(seeds)]
                    left = [row.left for row in own]
                    used = sum(row.used for row in own)
                    print(
                        f"{guidance}, {questions}, {answers} answers: {np.mean(left):.3f} of the error is left "
                        f"[{min(left):.3f} to {max(left):.3f}], used {used} of {seeds}",
                        flush=True,
                    )
                    rows += own
    if out is not None:
        with out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow([*Row._fields, "left"])
            writer.writerows([*row, f"{row.left:.4f}"] for row in rows)
    return rows


if __name__ == "__main__":
    tyro.cli(main, prog=Path(__file__).name, description=__doc__)
