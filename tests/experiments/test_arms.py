"""The study of arms: every piece is a command that would begin, some run, the table says what came out."""

import importlib
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry
from cuelearner_jax.runs.order import make_plan
from cuelearner_jax.studies import adapt, evaluate, train

FOLDER = Path(__file__).parents[2] / "experiments"


@pytest.fixture(scope="module")
def study():
    sys.path.insert(0, str(FOLDER))
    yield importlib.import_module("arms")
    sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def corrections(study):
    return importlib.import_module("_arms_adaptation")


def test_pieces_are_bounded_and_every_world_has_its_controls(study):
    assert len({piece.path for piece in study.PIECES}) == len(study.PIECES)
    for piece in study.PIECES:
        assert 0 < piece.minutes < 10
        assert bool(piece.labels) == any(registry.find(kind).asks for kind in piece.kinds)
    for world in study.WORLDS:
        own = {(piece.run, *piece.kinds, *piece.labels) for piece in study.TRAINED if piece.world == world}
        assert {("alone", "none"), ("stored", "relative", 100, 500), ("rlpd", "demonstration", 100, 500)} < own
        assert all(piece.seeds == 8 for piece in study.TRAINED)


@pytest.mark.parametrize("scale", ["paper", "quick", "smoke"])
def test_every_training_is_a_sweep_that_would_begin(study, scale, monkeypatch, tmp_path):
    orders = []
    monkeypatch.setattr(train, "run", lambda order: orders.append(make_plan(order).order))
    worlds = ("push", "push_in_fetch") if scale == "paper" else ("reach", "reach_in_fetch")
    for piece in (piece for piece in study.TRAINED if piece.world in worlds):
        left = study.scaled(piece, study.SCALES[scale])
        assert main(study.sweep_command("arm", left, tmp_path, resume=False)) == 0, piece.path
        assert left.options.get("arbiter", "episodes") == orders[-1].config.arbiter.NAME
        assert orders[-1].config.sizes.store_labelled == piece.run.startswith("stored")
        assert orders[-1].config.agent.NAME == "sac"
        assert orders[-1].task.bodies[0].name == ("fetch" if piece.world.endswith("_in_fetch") else "gripper")


def test_every_adaptation_is_a_command_that_would_begin(study, corrections, monkeypatch, tmp_path):
    """As far as its options go: it is parsed, with the suggestions of its scenario, and the world is made."""
    asked = []

    def stop(subject, request, *rest):
        asked.append(request)
        raise UserError("it would begin")

    monkeypatch.setattr(adapt, "run", stop)
    monkeypatch.setattr(evaluate, "run", stop)
    different = {(piece.run, piece.kinds): piece for piece in study.CORRECTED if not piece.source}
    for number, piece in enumerate(different.values()):
        main(study.commands(piece, tmp_path, "paper")[0])
        assert len(asked) == number + 1, piece.path
        if piece.kinds:
            by_labels = registry.find(piece.kinds[0]).form.by_eps
            assert asked[-1].judge_by == ("labels" if by_labels else piece.metric)
            assert (asked[-1].guidance,) == piece.kinds
            assert asked[-1].labels == (100,)
        assert asked[-1].task.skill == piece.where["task.skill"]


def test_agents_in_fetch_wait_until_they_are_trained_and_all_of_them_are_adapted(study, tmp_path, capsys):
    (piece,) = [one for one in study.CORRECTED if one.path == "reach_fetch/adapted/relative"]
    assert study.commands(piece, tmp_path, "paper") == []
    assert "run --pieces reach/stored/relative first" in capsys.readouterr().out
    run = tmp_path / piece.source
    run.mkdir(parents=True)
    (run / "config.json").write_text(json.dumps({"grid": {"seeds": [4000, 4001]}}))
    first, then = study.commands(piece, tmp_path, "paper")
    assert first[:4] == ["adapt", str(run), "--task.skill", "reach"]
    assert first[first.index("--base.seeds") + 1 :][:2] == ["4000", "4001"]
    assert first[first.index("--labels") + 1] == "200"
    assert ("--robot" in first, "--robot" in then) == (True, True)
    (tmp_path / piece.path).mkdir(parents=True)
    (tmp_path / piece.path / "measured.json").write_text("{}")
    assert study.commands(piece, tmp_path, "paper") == []  # it is done


def test_the_table_counts_the_seeds_that_reach_the_level(study):
    names = {"world": "reach", "run": "alone", "guidance": "none", "labels": 0}
    rows = [
        {**names, "step": step, **study.spread(values), "rewarded_steps": step, "each": dict(enumerate(values))}
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
    line, other = study.table([alone, guided], [], []).splitlines()[1:]
    assert "0.733 [" in line
    assert "at 200; 2 of 3, median step 167" in line
    assert "3 of 3, median step 100; 0.64 [" in other
    stopped = [row for row in faster if row["step"] == 100]
    ratio = study.compared([*rows, *stopped])[-1]["ratio"]
    assert ratio == [1.0, 1.0, 1.0]  # over 100 steps all three needed as many, or more, with labels and without


@pytest.mark.long
def test_pieces_run_are_told_and_are_not_run_again(study, tmp_path, capsys):
    pieces = [
        "reach/stored/relative",
        "reach/corrections/relative",
        "reach_turned/script",
        "reach_turned/adapted/scalar",
    ]
    command = ["--scale", "smoke", "--out", str(tmp_path), "--pieces", *pieces]
    assert study.main(command) == 0
    told = json.loads((tmp_path / "smoke" / "arms.json").read_text())
    found = {(row["run"], row["labels"], row["step"]) for row in told["training"]}
    assert {("stored", labels, step) for labels in (10, 20) for step in (0, 160)} < found
    assert {row["labels"] for row in told["guides"] if row["run"] == "corrections"} >= {10, 20}
    assert {(row["guidance"], row["mean"]) for row in told["adaptation"] if row["run"] == "script"} == {
        ("unchanged", 1.0),
        ("changed", 0.0),
        ("teacher", 1.0),
    }
    first = capsys.readouterr()
    assert study.main(command) == 0
    again = capsys.readouterr()
    assert "finished before, left as it is" in again.err
    assert again.out.splitlines()[-4:] == first.out.splitlines()[-4:]
