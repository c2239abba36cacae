"""What a run says of itself, grids that make no sense, and runs that are refused."""

import dataclasses

import numpy as np
import probes
import pytest
import walk_task
from small_policies import TASK, find

from cuelearner_jax.cli.sources import _with_teacher
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.runs import grid as runs
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.storage.folders import check_folder, prepare_folder
from cuelearner_jax.studies import train

GRID = Grid(("none", "relative"), seeds=(4, 9), labels=(10, 15))


def described(config=probes.CONFIG, grid=GRID, split="tuning", task=TASK):
    return runs.describe(task, config, grid, split)


@pytest.fixture
def out(tmp_path):
    """The folder of an interrupted run."""
    folder = tmp_path / "run"
    prepare_folder(folder, described(), clean=False)
    (folder / "none").mkdir()
    (folder / "none" / "results.jsonl").write_text("{}\n")
    return folder


# What it says of itself.


def test_a_run_comes_back_from_its_description(out):
    config = probes.config(scalars={"eps_deg": 7.5}, schedule={"random_steps": 4}, agent={"q_layers": (8, 4)})
    prepare_folder(out, described(config), clean=True)
    task, found, grid = runs.load(out, find)
    assert task is TASK
    assert found == config
    assert isinstance(found.agent.q_layers, tuple)
    assert grid == GRID


def test_a_run_of_another_robot_is_described_and_comes_back_on_that_robot(out, tmp_path):
    (own,) = TASK.bodies
    two = dataclasses.replace(TASK, bodies=(own, dataclasses.replace(own, name="other")))
    folder = tmp_path / "other"
    prepare_folder(folder, described(task=two.on("other")), clean=False)
    assert [body.name for body in runs.load(folder, lambda name: two)[0].bodies] == ["other", "point"]
    assert runs.load(out, lambda name: two)[0] is two
    with pytest.raises(UserError, match="was run with other values of robot: give the same options"):
        check_folder(out, described(task=two.on("other")), resume=True, overwrite=False)
    taught = _with_teacher(TASK, "probes:Expert")
    with pytest.raises(UserError, match="was run with other values of files"):
        check_folder(out, described(task=taught), resume=True, overwrite=False)


@pytest.mark.parametrize(
    ("name", "config", "grid", "options"),
    [
        ("agent.q_layers", probes.config(agent={"q_layers": (32,)}), GRID, {}),
        ("scalars.eps_deg", probes.config(scalars={"eps_deg": 6.0}), GRID, {}),
        ("seeds", probes.CONFIG, Grid(("none", "relative"), (4, 8), (10, 15)), {}),
        ("split", probes.CONFIG, GRID, {"split": "validation"}),
        ("task.name", probes.CONFIG, GRID, {"task": probes.make_task("another")}),
    ],
)
def test_everything_that_determines_results_is_described(out, name, config, grid, options):
    check_folder(out, described(), resume=True, overwrite=False)
    with pytest.raises(UserError, match=rf"was run with other values of {name}: give the same options"):
        check_folder(out, described(config, grid, **options), resume=True, overwrite=False)


def test_the_hash_of_a_configuration_depends_on_what_a_lane_learns_from_alone():
    values = described()
    found = runs.config_hash(values)
    assert runs.config_hash({**values, "format": 2, "grid": {}, "shard": [1, 2]}) == found
    assert runs.config_hash({**values, "split": "other"}) != found
    assert runs.config_hash({**values, "agent": {**values["agent"], "polyak": 0.5}}) != found


# Grids.


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (Grid(("relativ",), (0,), (10,)), "unknown guidance 'relativ'"),
        (Grid((), (0,), (10,)), "give each kind once, and at least one"),
        (Grid(("none",), (), (10,)), "seeds must be different numbers"),
        (Grid(("none",), (-1,), (10,)), "seeds must be different numbers"),
        (Grid(("relative",), (0,), ()), "--labels: give each budget once"),
        (Grid(("relative",), (0,), (10, 10)), "--labels: give each budget once"),
        (Grid(("relative",), (0,), (10, -1)), "a label budget of -1 teaches nothing"),
    ],
)
def test_grids_that_make_no_sense_are_refused(grid, message, tmp_path):
    with pytest.raises(UserError, match=message):
        runs.check_grid(grid)
    with pytest.raises(UserError, match=message):
        train.run(Order(TASK, probes.CONFIG, grid, tmp_path / "run"))
    assert list(tmp_path.iterdir()) == []


def test_answers_that_could_never_differ_are_refused(tmp_path):
    config = walk_task.config(scalars={"eps_deg": 5.0})
    with pytest.raises(UserError, match="eps_deg is 5 shares, and every answer of relative would be the same"):
        train.run(Order(walk_task.TASK, config, GRID, tmp_path / "run"))


@pytest.mark.parametrize("name", ["failed", "step", "scalars.eps_deg", "reward"])
def test_a_metric_that_is_called_as_another_column_is_refused(name, tmp_path, monkeypatch):
    usual, other = probes.Window.step, lambda after, step: (after, step.replace(metrics={name: step.reward}))
    monkeypatch.setattr(probes.Window, "step", lambda *arguments: other(*usual(*arguments)))
    with pytest.raises(UserError, match=f"a metric or outcome is called '{name}', as another column of results"):
        train.run(Order(TASK, probes.CONFIG, Grid(("none",), (0,), ()), tmp_path / "run"))
    assert list(tmp_path.iterdir()) == []


def test_the_budget_0_is_the_unguided_agent():
    both = Grid(("relative", "heuristic"), (4,), (0, 10))
    assert runs.with_control(both) == Grid(("none", "relative", "heuristic"), (4,), (10,))
    assert runs.with_control(runs.with_control(both)) == runs.with_control(both)
    alone = Grid(("heuristic",), (4,), (0,))  # asks nothing, whatever the budgets
    assert runs.with_control(alone) == alone
    assert runs.with_control(Grid(("relative", "none", "heuristic"), (4,), (0,))).guidance == ("none", "heuristic")


@pytest.mark.parametrize(
    ("words", "seeds"),
    [("3", (7, 8, 9)), ("0:2", (0, 1)), ("2:2", "makes 0 seeds"), ("5:2", "makes -3 seeds"), ("1-3", "such as 0:16")],
)
def test_seeds_are_a_number_or_a_range(words, seeds):
    if isinstance(seeds, tuple):
        assert runs.parse_seeds(words, first=7) == seeds
        return
    with pytest.raises(UserError, match=seeds):
        runs.parse_seeds(words, first=7)


def test_lanes_are_seeds_times_budgets_and_one_a_seed_without_labels():
    relative, none = (guidances.make(kind, probes.SIZES, probes.Window()) for kind in ("relative", "none"))
    seeds, budgets = GRID.lanes(relative)
    assert list(zip(seeds.tolist(), budgets.tolist(), strict=True)) == [(4, 10), (9, 10), (4, 15), (9, 15)]
    seeds, budgets = GRID.lanes(none)
    assert list(zip(seeds.tolist(), budgets.tolist(), strict=True)) == [(4, 0), (9, 0)]
    assert seeds.dtype == budgets.dtype == np.int32
