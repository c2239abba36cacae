"""The study of arms: every piece is a sweep that would begin."""

import importlib
import sys
from pathlib import Path

import pytest
from _pieces import scaled, sweep_command

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
