"""The study of labels as a prior: every piece is a sweep that would begin, one runs, the table says what came out."""

import importlib
import json
import math
import sys
from pathlib import Path

import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.guides import registry
from cuelearner_jax.runs.order import make_plan
from cuelearner_jax.studies import train

FOLDER = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def study():
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("prior")
    sys.path.remove(str(FOLDER))


def test_pieces_are_bounded_and_every_world_has_its_controls(study):
    assert len({piece.path for piece in study.PIECES}) == len(study.PIECES)
    for piece in study.PIECES:
        assert 0 < piece.minutes < 10
        assert bool(piece.labels) == registry.find(piece.kinds[0]).asks
    for world in study.TASKS:
        own = {(piece.run, *piece.kinds) for piece in study.PIECES if piece.world == world}
        assert {("alone", "none"), ("prior", "any_aim"), ("prior", "rule"), ("shuffled", "intent")} < own


@pytest.mark.parametrize("scale", ["paper", "start", "smoke"])
def test_every_piece_is_a_sweep_that_would_begin(study, scale, monkeypatch, tmp_path):
    orders = []
    monkeypatch.setattr(train, "run", lambda order: orders.append(make_plan(order).order))
    different = {(str(piece.options), piece.kinds): piece for piece in study.PIECES if piece.world in ("easy", "halls")}
    for piece in different.values():
        left = study.scaled(piece, study.SCALES[scale])
        if left is not None:
            assert main(study.sweep_command(study.TASKS[piece.world], left, tmp_path, resume=False)) == 0, piece.path
            assert left.options["arbiter"] == orders[-1].config.arbiter.NAME


def test_budgets_that_no_piece_has_are_refused_and_known_ones_select(study, capsys):
    with pytest.raises(SystemExit, match="2"):
        study.main(["--pieces", "regulation/prior", "--labels", "25", "7", "--list"])
    assert "--labels 7: these pieces have 25, 100, 500" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        study.main(["--pieces", "easy/alone", "--labels", "25"])
    assert "these pieces have no labels" in capsys.readouterr().err
    assert study.main(["--pieces", "regulation/prior/intent", "--labels", "25", "--list"]) == 0
    assert "    8 lanes" in capsys.readouterr().out


def row(step, mean):
    return {"step": step, "mean": mean}


def test_steps_to_a_level_lie_on_straight_lines(study):
    rows = [row(0, 0.1), row(100, 0.5), row(200, 1.0)]
    assert study.steps_to(0.9, rows) == pytest.approx(180)
    assert study.steps_to(0.05, rows) == 0
    assert math.isinf(study.steps_to(1.1, rows))
    assert study.steps_to(1.0, rows) == 200


@pytest.mark.long
def test_a_piece_runs_is_told_and_is_not_run_again(study, tmp_path, capsys):
    command = ["--scale", "smoke", "--out", str(tmp_path), "--pieces", "easy/prior/intent", "easy/alone"]
    assert study.main(command) == 0
    told = json.loads((tmp_path / "smoke" / "prior.json").read_text())
    found = {(row["run"], row["labels"], row["step"]): row for row in told["rows"]}
    assert set(found) == {("prior", n, s) for n in (10, 20) for s in (0, 100)} | {("alone", 0, s) for s in (0, 100)}
    assert sum(found["prior", 20, 100]["arms"].values()) == 1
    assert found["prior", 20, 100]["rewarded_steps"] == 100 + 3 * 200
    assert found["alone", 0, 100]["rewarded_steps"] == 100
    first = capsys.readouterr()
    assert study.main(command) == 0
    again = capsys.readouterr()
    assert "finished before, left as it is" in again.err
    assert again.out.splitlines()[-4:] == first.out.splitlines()[-4:]
