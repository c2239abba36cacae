"""Labels from a file: what fits a task and its grid is taken, anything else refused."""

import numpy as np
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.records import label_files
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order, read_labels

TASK = {"name": "window", "half_width_deg": 28.0}
EPS = probes.CONFIG.scalars.eps_deg


@pytest.fixture
def path(tmp_path):
    return tmp_path / "labels.parquet"


def written(path, task=None, answers="relative", eps_deg=EPS, obs_size=2):
    rng = np.random.default_rng(0)
    draw = lambda size: rng.normal(size=(2, 20, size)).astype(np.float32)  # noqa: E731
    labels = probes.label_set(draw(obs_size), draw(2), np.sign(draw(1)), np.ones((2, 20), bool))
    label_files.write(path, task or TASK, answers, eps_deg, np.array([4, 9]), labels)


GRID = Grid(("none", "relative"), seeds=(4, 9), labels=(10, 15))


def read_for(path, grid=GRID, task=None):
    return read_labels(Order(task or probes.make_task(), probes.CONFIG, grid, path.parent / "run", labels_from=path))


def test_labels_that_fit_a_run(path):
    written(path)
    assert len(read_for(path).seeds) == 40


def test_labels_of_another_task_are_refused(path):
    written(path, task={"name": "billiards"})
    with pytest.raises(UserError, match="labels of billiards"):
        read_for(path)


def test_labels_of_other_observations_are_refused(path):
    written(path, obs_size=3)
    with pytest.raises(UserError, match="3 observations"):
        read_for(path)


def test_answers_of_another_form_are_refused(path):
    written(path, answers="demonstration")
    with pytest.raises(UserError, match="demonstration answers"):
        read_for(path)


def test_labels_of_another_strength_are_refused(path):
    written(path, eps_deg=EPS / 2)
    with pytest.raises(UserError, match=f"give --scalars.eps-deg {EPS / 2:g}"):
        read_for(path)


def test_labels_for_a_grid_that_asks_for_none_are_refused(path):
    written(path)
    with pytest.raises(UserError, match="--guidance relative"):
        read_for(path, Grid(("none", "heuristic"), seeds=(4, 9), labels=(10,)))


def test_a_budget_beyond_the_file_is_refused(path):
    written(path)
    with pytest.raises(UserError, match="the budget is 21"):
        read_for(path, Grid(("relative",), seeds=(4, 9), labels=(10, 21)))
