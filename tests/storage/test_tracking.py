"""Curves for trackers: what is written of an evaluation, by the trackers and by a run that is followed."""

import struct

import numpy as np
import pytest
from probes import config, make_task
from tensorboardX.proto.event_pb2 import Event

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.storage import results, tracking
from cuelearner_jax.studies import train

ROW = {
    "seed": np.array([1, 2, 1, 2]),
    "labels": np.array([10, 10, 20, 20]),
    "step": 100,
    "wall_s": 2.0,
    "reward": np.array([1.0, 3.0, np.nan, 5.0]),
    "collision": np.array([0.5, 0.5, np.nan, np.nan]),
}


def points(folder):
    """(tag, step) -> value in event files: length, checksum, message, checksum."""
    found = {}
    for file in sorted(folder.rglob("events*")):
        data = file.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            event = Event.FromString(data[12 : 12 + size])
            found.update({(value.tag, event.step): value.simple_value for value in event.summary.value})
            data = data[16 + size :]
    return found


def test_means_over_the_seeds_of_each_budget_leave_out_failed_lanes():
    assert tracking.means(ROW) == {
        "collision/labels_10": 0.5,
        "reward/labels_10": 2.0,
        "reward/labels_20": 5.0,
        "wall_s/labels_10": 2.0,
        "wall_s/labels_20": 2.0,
    }


def test_a_followed_run_has_its_results_as_points_for_tensorboard(tmp_path):
    order = Order(make_task(), config(schedule={"total_steps": 32}), Grid(("none",), (0, 1), (0,)), tmp_path / "run")
    train.run(Order(**{**vars(order), "track": "tensorboard"}))
    table = results.read(tmp_path / "run").to_pylist()
    wanted = {
        ("reward/labels_0", step): np.mean([row["reward"] for row in table if row["step"] == step])
        for step in (0, 16, 32)
    }
    found = points(tmp_path / "run" / "none" / "tensorboard")
    assert {key: found[key] for key in wanted} == pytest.approx(wanted, rel=1e-6)


def test_unknown_and_missing_trackers_are_refused_and_none_is_fine(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="unknown tracker 'tensorbord', did you mean 'tensorboard'"):
        tracking.check("tensorbord")
    monkeypatch.setattr(tracking, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="--track wandb needs wandb: pip install wandb"):
        tracking.check("wandb")
    tracking.check(None)
    with tracking.open_tracker(None, tmp_path, {}, 0) as tracker:
        assert tracker is None
