"""Labels from a file: what fits a task and its grid is taken, anything else refused."""

import dataclasses

import numpy as np
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import read_labels
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import label_files

TASK = {"name": "window", "half_width_deg": 28.0}
EPS = probes.CONFIG.scalars.eps_deg


@pytest.fixture
def path(tmp_path):
    return tmp_path / "labels.parquet"


def written(path, task=None, answers="relative", eps_deg=EPS, obs_size=2, spoil=None):
    rng = np.random.default_rng(0)
    draw = lambda size: rng.normal(size=(2, 20, size)).astype(np.float32)  # noqa: E731
    action = draw(2)
    action /= np.linalg.norm(action, axis=-1, keepdims=True)
    rows = {"obs": draw(obs_size), "action": action, "answer": np.sign(draw(1))}
    if spoil:
        rows[spoil[0]][1, 7] = spoil[1]
    labels = probes.label_set(rows["obs"], rows["action"], rows["answer"], np.ones((2, 20), bool))
    label_files.write(path, task or TASK, answers, DIRECTIONS, eps_deg, np.array([4, 9]), labels)


GRID = Grid(("none", "relative"), seeds=(4, 9), labels=(10, 15))


def read_for(path, grid=GRID, task=None, config=probes.CONFIG):
    return read_labels(path, task or probes.make_task(), config.task, config.sizes, config.scalars, grid)


def test_labels_that_fit_a_run(path):
    written(path)
    assert len(read_for(path).seeds) == 40
    task = dataclasses.replace(probes.make_task(), labels_hold=("half_width_deg",))
    written(path, task={"name": "window", "half_width_deg": 14.0})
    assert len(read_for(path, task=task).seeds) == 40
    with pytest.raises(ValueError, match=r"labels_hold names .'colour'"):
        dataclasses.replace(task, labels_hold=("colour",))


@pytest.mark.parametrize(
    ("given", "grid", "says"),
    [
        ({"task": {"name": "billiards"}}, GRID, "labels of billiards"),
        ({"task": {"name": "window", "half_width_deg": 14.0}}, GRID, r"half_width_deg \(14.0; this run has 28.0\)"),
        ({"obs_size": 3}, GRID, r"observations have the shape \(40, 3\): give \(labels, 2\)"),
        ({"answers": "demonstration"}, GRID, "demonstration answers"),
        ({"eps_deg": EPS / 2}, GRID, f"give --scalars.eps-deg {EPS / 2:g}"),
        ({}, Grid(("none", "heuristic"), (4, 9), (10,)), "--guidance relative"),
        ({}, Grid(("relative",), (4, 9), (10, 21)), "the budget is 21"),
        # which nobody can have given
        ({"spoil": ("obs", np.nan)}, GRID, "observations hold numbers that are not finite"),
        ({"spoil": ("action", (0.8, 0.8))}, GRID, "actions are no unit vectors"),
        ({"spoil": ("answer", 0.5)}, GRID, "an answer is none of -1, 0, 1"),
    ],
)
def test_labels_that_do_not_fit_a_run_are_refused(path, given, grid, says):
    written(path, **given)
    with pytest.raises(UserError, match=says):
        read_for(path, grid)
