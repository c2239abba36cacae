"""The studies of label efficiency: every piece is a sweep that would begin; recorded tables are their data's."""

import csv
import importlib
from pathlib import Path

import pytest
from _pieces import report_command, scaled, sweep_command

from cuelearner_jax.cli import main
from cuelearner_jax.guides import registry
from cuelearner_jax.report.document import contents_of
from cuelearner_jax.report.efficiency import Question
from cuelearner_jax.runs.order import make_plan
from cuelearner_jax.studies import train

ROOT = Path(__file__).parents[2]


@pytest.fixture(params=["billiards", "navigation"])
def experiment(request, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    return importlib.import_module(f"{request.param}_bootstrapping").EXPERIMENT


@pytest.mark.parametrize("scale", ["smoke", pytest.param("paper", marks=pytest.mark.long)])
def test_every_piece_is_a_sweep_that_would_begin(experiment, scale, monkeypatch, tmp_path):
    """The command line itself plans each: options exist, values are legal, counts divide each other."""
    orders = []
    monkeypatch.setattr(train, "run", lambda order: orders.append(make_plan(order).order))
    assert len({piece.path for piece in experiment.pieces}) == len(experiment.pieces)
    different = {}
    for piece in experiment.pieces:
        assert bool(piece.labels) == any(registry.find(kind).asks for kind in piece.kinds), piece.path
        if left := scaled(piece, experiment.scales[scale]):
            different.setdefault((str(left.options), left.kinds), left)
    for piece in [*different.values()][:: 4 if scale == "smoke" else 1]:
        assert main(sweep_command(experiment.task, piece, tmp_path, resume=False)) == 0, piece.path
        assert orders[-1].grid.labels == piece.labels or not piece.labels
        assert orders[-1].out == tmp_path / piece.path


def test_a_report_is_asked_what_its_runs_can_answer(experiment, tmp_path):
    world = experiment.pieces[0].world
    assert report_command(experiment, world, tmp_path, "paper") is None
    for kind, reference in (("none", False), ("relative", True)):
        piece = next(piece for piece in experiment.pieces if piece.world == world and piece.kinds == (kind,))
        (tmp_path / piece.path).mkdir(parents=True)
        (tmp_path / piece.path / "config.json").touch()
        assert ("--reference" in report_command(experiment, world, tmp_path, "paper")) == reference


@pytest.mark.long
def test_a_smoke_runs_and_is_resumed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    data = importlib.import_module("billiards_bootstrapping")
    asked = ["--scale", "smoke", "--out", str(tmp_path), "--pieces", "easy/frame/none", "easy/frame/relative"]
    assert data.main(asked) == 0
    with (tmp_path / "smoke/easy/report/efficiency.csv").open() as file:
        rows = [(row["run"], row["guidance"], row["labels"]) for row in csv.DictReader(file)]
    assert rows == [("frame", "none", "0"), *(("frame", "relative", labels) for labels in ("5", "10", "15"))]
    assert data.main([*asked, "--resume"]) == 0
    assert data.main(asked) == 2  # begun already, and --resume was not given


def test_labels_for_an_equal_mean_are_what_the_recorded_runs_give():
    """Of the runs that are kept: navigation seen from the action."""
    data = ROOT / "docs/data/bootstrapping/clutter"
    question = Question(level=0.9)
    found = contents_of([data / "frame"], "success", by_run=True, question=question).efficiency.tables["equal_area"]
    mine = {(row["reference_labels"], row["guidance"]): row for row in found if row["reference"] == "relative"}
    with (data / "report/equal_area.csv").open(newline="") as file:
        recorded = [row for row in csv.DictReader(file) if row["run"] == "frame"]
    assert recorded
    for known in recorded:
        row = mine[int(known["reference_labels"]), known["guidance"]]
        assert row["mean"] == pytest.approx(float(known["mean"]))
        for name in ("labels", "labels_above", "labels_below"):
            assert row.get(name) == (pytest.approx(float(known[name])) if known[name] else None)
