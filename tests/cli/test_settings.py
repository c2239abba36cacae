"""Grids of settings: lanes are those of a sweep of each value, in one program; stopped, chosen and refused."""

import json

import pyarrow.parquet as pq
import pytest
from small_runs import BANDIT, rows, stopping_at

from cuelearner_jax.cli import main
from cuelearner_jax.runs import program
from cuelearner_jax.storage import results

SWEEP = ["sweep", BANDIT, "--seeds", "7:8", "--labels", "10", "--guidance", "relative"]
GRID = [*SWEEP, "--scalars.eps-deg", "2", "5"]
TWO, FIVE = "scalars.eps_deg=2", "scalars.eps_deg=5"


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """A grid of two settings, and beside it a sweep of each; and how many programs the grid took."""
    folder, compiled = tmp_path_factory.mktemp("settings"), []
    make = program.make_program
    recorded = lambda *a, **b: compiled.append(make(*a, **b)) or compiled[-1]  # noqa: E731
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cuelearner_jax.runs.lanes.make_program", recorded)
        assert main([*GRID, "--out", str(folder / "grid")]) == 0
    assert len(compiled) == 2
    assert compiled[0] is compiled[1]
    assert compiled[0].train._cache_size() == 1
    for name, eps in ((TWO, "2"), (FIVE, "5")):
        assert main([*SWEEP, "--scalars.eps-deg", eps, "--out", str(folder / name)]) == 0
    return folder


def test_lanes_are_those_of_a_sweep_of_each_value(grid):
    assert sorted(path.name for path in (grid / "grid").iterdir()) == [TWO, FIVE]
    for name, eps in ((TWO, 2.0), (FIVE, 5.0)):
        own, alone = grid / "grid" / name, grid / name
        assert rows(own) == rows(alone)
        labels = [pq.read_table(one / "relative" / "labels.parquet") for one in (own, alone)]
        assert labels[0].equals(labels[1])
        table, plain = results.read(own), results.read(alone)
        assert [*{*table.column_names} - {*plain.column_names}] == ["scalars.eps_deg"]
        assert set(table["scalars.eps_deg"].to_pylist()) == {eps}
        assert b"varies in a sweep" in table.field("scalars.eps_deg").metadata[b"description"]
        assert set(table["config_hash"].to_pylist()) == set(plain["config_hash"].to_pylist())
        assert "setting" not in json.loads((alone / "config.json").read_text())
    assert rows(grid / TWO) != rows(grid / FIVE)


def test_a_stopped_grid_goes_on_and_grows(grid, tmp_path, capsys):
    out = tmp_path / "grid"
    with stopping_at(5):  # one round of labels and two stretches a setting
        assert main([*GRID, "--out", str(out)]) == 130
    assert "go on with the same command and --resume" in capsys.readouterr().err
    assert (out / TWO / "relative" / "results.parquet").exists()
    assert not (out / FIVE / "relative" / "results.parquet").exists()
    assert main([*GRID, "10", "--out", str(out), "--resume"]) == 0
    assert [rows(out / name) for name in (TWO, FIVE)] == [rows(grid / name) for name in (TWO, FIVE)]
    assert (out / "scalars.eps_deg=10" / "relative" / "results.parquet").exists()


def test_a_setting_is_a_run_and_the_grid_is_reported_by_settings(grid, refused, tmp_path, capsys):
    folder = grid / "grid"
    says = f"holds 2 runs of a grid of settings: give one, as {folder / TWO}"
    for command in (["evaluate"], ["export", "--out", tmp_path / "file"], ["render", "--out", tmp_path / "film"]):
        refused([command[0], folder, *command[1:]], says, folder)
    assert main(["evaluate", str(folder / FIVE), "--steps", "100", "--envs", "20"]) == 0
    capsys.readouterr()
    assert main(["report", str(folder), "--json"]) == 0
    assert [(row["run"], row["seeds"]) for row in json.loads(capsys.readouterr().out)["rows"]] == [(TWO, 1), (FIVE, 1)]


def test_impossible_grids_are_refused_before_anything_is_trained(grid, refused, tmp_path):
    out = ["--out", tmp_path / "run"]
    refused([*GRID, "2.0", *out], "--scalars.eps_deg: give each value once", tmp_path)
    refused([*GRID, "-3", *out], "scalars.eps_deg is -3.0: give a number above 0", tmp_path)
    refused([*GRID, "x", *out], "Error parsing --scalars.eps-deg: could not convert", tmp_path)
    refused([*SWEEP, "--scalars.says", "all", "one", *out], "Unrecognized options: one", tmp_path)
    refused(["train", *GRID[1:2], "--scalars.eps-deg", "2", "5", *out], "train takes one value", tmp_path)
    refused([*GRID, *out, "--resume"], "nothing to resume in", tmp_path)
    refused([*GRID, "--out", grid / "grid"], "is not empty: give --resume to go on", grid)
    refused([*GRID, "--out", grid / TWO], "holds a run of one setting: give another --out", grid)
    refused([*GRID[:-1], "--out", grid / "grid", "--overwrite"], "is not a run folder", grid)
    refused([*GRID[:-1], "3", "--out", grid / "grid", "--overwrite"], f"{FIVE} is of another grid", grid)
    refused([*SWEEP, "--out", grid / "grid"], "is not empty", grid)
    other, says = ["--scalars.eps-deg", "10", "20", "--agent.learning-rate"], f"{TWO} is of a grid with another "
    refused([*SWEEP, *other, "0.5", "--out", grid / "grid"], f"{says}agent.learning_rate: give the same options", grid)
    refused([*SWEEP, *other, "0.5", "0.1", "--out", grid / "grid"], f"{says}setting: give", grid)
