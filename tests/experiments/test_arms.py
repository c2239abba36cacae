"""The study of arms: every piece is a command that would begin, and the table says what came out."""

import importlib
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from _pieces import scaled, spread, sweep_command

from cuelearner_jax.cli import main
from cuelearner_jax.runs.order import make_plan
from cuelearner_jax.studies import train

FOLDER = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def study():
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("arms")
    sys.path.remove(str(FOLDER))


@pytest.mark.parametrize("scale", ["paper", "smoke"])
def test_every_training_is_a_sweep_that_would_begin(study, scale, monkeypatch, tmp_path):
    orders = []
    monkeypatch.setattr(train, "run", lambda order: orders.append(make_plan(order).order))
    for piece in (piece for piece in study.PIECES if piece.world == ("push" if scale == "paper" else "reach")):
        command = sweep_command("arm", scaled(piece, study.SCALES[scale]), tmp_path, resume=False)
        assert main(command) == 0, piece.path
        assert orders[-1].config.sizes.store_labelled == piece.run.startswith("stored")
        assert orders[-1].config.agent.NAME == "sac"
    assert len({piece.path for piece in study.PIECES}) == len(study.PIECES)


def test_the_table_counts_the_seeds_that_reach_the_level(study):
    names = {"world": "reach", "run": "alone", "guidance": "none", "labels": 0}
    rows = [
        {**names, "step": step, **spread(values), "each": dict(enumerate(values))}
        for step, values in ((0, [0.0, 0.0, 0.0]), (100, [0.8, 0.4, 0.0]), (200, [1.0, 1.0, 0.2]))
    ]
    steps = study.reached(rows)
    assert steps[:2] == [100, pytest.approx(100 + 100 * 0.4 / 0.6)]
    assert math.isinf(steps[2])
    faster = [{**row, "run": "stored", "each": dict.fromkeys(row["each"], 0.8)} for row in rows[1:]]
    alone, guided = sorted(study.compared([*rows, *faster]), key=lambda row: row["run"])
    assert alone["reached"] == 2
    assert "ratio" not in alone
    ratio, low, high = guided["ratio"]
    assert ratio == pytest.approx(100 / np.mean([100, 100 + 100 * 0.4 / 0.6, 200]))
    assert low < ratio < high
    line, other = study.table([alone, guided]).splitlines()[1:]
    assert "at 200; 2 of 3, from step never [100, never] on" in line
    assert "3 of 3, from step 100 [100, 100] on; 0.64 [" in other
