"""Labels from a file: what fits a task and its grid is taken, anything else refused."""

import dataclasses

import numpy as np
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order, read_labels
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import label_files
from cuelearner_jax.studies import train

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


def test_labels_of_another_task_are_refused(path):
    written(path, task={"name": "billiards"})
    with pytest.raises(UserError, match="labels of billiards"):
        read_for(path)


def test_labels_of_other_observations_are_refused(path):
    written(path, obs_size=3)
    with pytest.raises(UserError, match=r"observations have the shape \(40, 3\): give \(labels, 2\)"):
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


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (("obs", np.nan), "observations hold numbers that are not finite"),
        (("action", np.inf), "actions hold numbers that are not finite"),
        (("answer", np.nan), "answers hold numbers that are not finite"),
        (("action", 0.0), "actions are no unit vectors"),
        (("action", (0.8, 0.8)), "actions are no unit vectors"),
        (("answer", 0.5), "an answer is none of -1, 0, 1"),
    ],
)
def test_labels_that_nobody_can_have_given_are_refused(path, spoil, says):
    written(path, spoil=spoil)
    with pytest.raises(UserError, match=says):
        read_for(path)


def test_labels_of_another_world_are_refused_but_for_what_they_do_not_depend_on(path):
    written(path, task={"name": "window", "half_width_deg": 14.0})
    with pytest.raises(UserError, match=r"another task.half_width_deg \(14.0; this run has 28.0\)"):
        read_for(path)
    task = probes.make_task()
    assert len(read_for(path, task=dataclasses.replace(task, labels_hold=("half_width_deg",))).seeds) == 40
    with pytest.raises(ValueError, match="labels_hold names 'colour'"):
        dataclasses.replace(task, labels_hold=("colour",))
    written(path, task={"name": "window", "half_width_deg": "wide"})
    with pytest.raises(UserError, match="half_width_deg is 'wide' in a file of another version"):
        read_for(path)


SMALL = {"feedback_layers": (4,), "fit_steps": 20, "lanes_per_block": 1}
RUN = probes.config(sizes=SMALL, schedule={"total_steps": 16, "guidance_until": 16}, agent={"q_layers": (4,)})


def test_demonstrations_are_written_and_taken_again_by_their_own_kind_alone(tmp_path):
    grid, task = Grid(("demonstration",), (4,), (10,)), probes.make_task()
    train.run(Order(task, RUN, grid, tmp_path / "asked"))
    path = tmp_path / "asked" / "demonstration" / "labels.parquet"
    file = label_files.read(path)
    assert (file.answers, file.eps, file.labels.answer.shape) == ("demonstration", None, (10, 2))
    train.run(Order(task, RUN, grid, tmp_path / "given", labels_from=path))
    again = label_files.read(tmp_path / "given" / "demonstration" / "labels.parquet")
    np.testing.assert_array_equal(again.labels.answer, file.labels.answer)
    for other in ("relative", "scalar", "dcoach"):
        with pytest.raises(UserError, match=f"holds demonstration answers, but guidance {other} needs"):
            read_for(path, Grid((other,), (4,), (10,)))


def test_demonstrations_that_are_no_actions_are_refused(path):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(3, 1, 20, 2)).astype(np.float32)
    action = rows[1] / np.linalg.norm(rows[1], axis=-1, keepdims=True)
    labels = probes.label_set(rows[0], action, rows[2], np.ones((1, 20), bool))
    label_files.write(path, TASK, "demonstration", DIRECTIONS, None, np.array([4]), labels)
    with pytest.raises(UserError, match="answers are no unit vectors"):
        read_for(path, Grid(("demonstration",), (4,), (10,)))


def test_the_nearest_good_action_is_refused_where_the_teacher_knows_the_best_one_alone(tmp_path):
    config = dataclasses.replace(RUN, scalars=dataclasses.replace(RUN.scalars, answer="nearest"))
    order = Order(probes.make_task(), config, Grid(("relative",), (4,), (10,)), tmp_path / "run")
    with pytest.raises(UserError, match=r"give --scalars\.answer best"):
        train.run(order)
    assert not (tmp_path / "run").exists()
