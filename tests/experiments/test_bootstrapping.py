"""The studies of label efficiency: every piece is a sweep that would begin; recorded tables are their data's."""

import csv
from pathlib import Path

import billiards_bootstrapping
import navigation_bootstrapping
import pytest
from _pieces import scaled, sweep_command

from cuelearner_jax.cli import main
from cuelearner_jax.guides import registry
from cuelearner_jax.report.document import ReportRequest, contents_of
from cuelearner_jax.runs.order import make_plan
from cuelearner_jax.studies import train

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("study", [billiards_bootstrapping, navigation_bootstrapping], ids=lambda study: study.__name__)
@pytest.mark.parametrize("scale", ["smoke", pytest.param("paper", marks=pytest.mark.long)])
def test_every_piece_is_a_sweep_that_would_begin(study, scale, monkeypatch, tmp_path):
    """The command line itself plans each: options exist, values are legal, counts divide each other."""
    experiment, orders = study.EXPERIMENT, []
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


def test_labels_for_an_equal_mean_are_what_the_recorded_runs_give():
    """Of the runs that are kept: navigation seen from the action."""
    data = ROOT / "docs/data/bootstrapping/clutter"
    request = ReportRequest(metric="success", by_run=True, level=0.9)
    found = contents_of([data / "frame"], request).efficiency.tables["equal_area"]
    mine = {(row["reference_labels"], row["guidance"]): row for row in found if row["reference"] == "relative"}
    with (data / "report/equal_area.csv").open(newline="") as file:
        recorded = [row for row in csv.DictReader(file) if row["run"] == "frame"]
    assert recorded
    for known in recorded:
        row = mine[int(known["reference_labels"]), known["guidance"]]
        assert row["mean"] == pytest.approx(float(known["mean"]))
        for name in ("labels", "labels_above", "labels_below"):
            assert row.get(name) == (pytest.approx(float(known[name])) if known[name] else None)
