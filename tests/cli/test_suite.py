"""`cuelearner suite`: cells that make sense, a tiny suite with a kind of one's own, and bad input."""

import os
import re
import sys
import tomllib

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from small_runs import BANDIT, listing

from cuelearner_jax.cli import main
from cuelearner_jax.cli import suite as command
from cuelearner_jax.storage.whole import hold
from cuelearner_jax.studies import suite

TINY = f"""
kinds = ["none", "reading"]
[teachers]
right = {{}}
one_cue = {{ says = "one" }}
[worlds.train]
use = "bootstrap"
subject = "{BANDIT}"
metric = "reward"
[worlds.correct]
use = "adapt"
subject = "page_task:left_of --task {BANDIT}"
metric = "reward"
ends = [-1.0, 3.0]
bound = 90.0
scalars = {{ eps_deg = 10.0 }}
sizes = {{ feedback_layers = [16], fit_steps = 20 }}
[scales.tiny]
labels = [20]
fault_labels = [20]
seeds = 2
is_short = true
teachers = ["right", "one_cue"]
worlds = {{ train = {{}}, correct = {{}} }}
"""
CLONE = "examples.clone:Clone"


def test_the_cells_of_every_scale_make_sense_for_their_worlds():
    table = tomllib.loads(suite.TABLE.read_text())
    assert {"smoke", "quick", "paper"} == set(table["scales"])
    scale = table["scales"]["paper"]
    assert set(scale["worlds"]) == set(table["worlds"])
    with pytest.raises(KeyError, match="wronng"):
        suite.cells_of(table, scale | {"teachers": ["wronng"]}, [], [])
    for name in ("billiards_one_ball", "arm_reach_turned_camera", "zoo_region"):
        world = command._world(name, table["worlds"][name])
        cells = {cell.name: cell.obstacle() for cell in suite.cells_of(table, scale, [world], table["kinds"])}
        place, has_cues = f"{world.use}/{name}", not name.startswith("billiards")
        assert (cells[f"{place}/right/reading"] is None) == (world.use == suite.ADAPT)
        assert (cells[f"{place}/right/heuristic"] is None) == (name != "zoo_region")
        assert (cells[f"{place}/one_cue/relative"] is None) == has_cues
        assert all(cells[f"{place}/{name}"] for name in ("one_cue/scalar", "wrong/none"))
        biased = suite.Cell(world, "biased", table["teachers"]["biased"], "relative", (25,), 1).config().scalars
        assert biased.teacher_bias_deg == biased.eps_deg > 0
        assert cells[f"{place}/wrong/scalar"] is None
    assert suite._scores(pa.array([None, 1.0]), (0.0, 2.0)).to_pylist() == [None, 0.5]


def test_a_suite_is_one_table_and_one_page_and_goes_on(tmp_path, capsys, monkeypatch):
    (table := tmp_path / "tiny.toml").write_text(TINY)
    words = ["suite", "--scale", "tiny", "--table", str(table), "--out", str(tmp_path / "out")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # of the processes
    with hold(tmp_path / "out" / ".train_none.lock", tmp_path):  # as another process does that has taken these cells
        assert main([*words, "--processes", "2"]) == 0
    printed = capsys.readouterr().out
    assert "2 processes run the cells" in printed
    assert "2 of 3 cells are done; the same command goes on" in printed
    assert main([*words, "--guidance", CLONE, "--processes", "1"]) == 0
    rows = pq.read_table(tmp_path / "out" / "suite.parquet")
    lanes = rows.group_by(["use", "teacher", "guidance", "labels", "seed", "step"]).aggregate([]).num_rows
    assert lanes == rows.num_rows
    of_use = {use: [row for row in rows.to_pylist() if row["use"] == use] for use in suite.USES}
    assert {row["guidance"] for row in of_use["bootstrap"]} == {"none", "clone"}
    assert {row["guidance"] for row in of_use["adapt"]} == {"none", "reading", "clone"}
    assert all(row["rewarded_steps"] == row["step"] for row in of_use["bootstrap"])
    assert all(row["score"] == (row["reward"] + 1.0) / 4.0 for row in of_use["adapt"])
    assert all((row["rewarded_steps"] > 0) == (row["guidance"] == "clone") for row in of_use["adapt"])
    assert "reading corrects finished policies only" in (tmp_path / "out" / "suite.md").read_text()
    assert (tmp_path / "out" / "suite.png").exists()
    before = {k: of for k, of in listing(tmp_path / "out").items() if re.search("/bootstrap/|/adapt/|suite.toml", k)}
    assert main(words) == 0  # nothing is run again, and the own kind's rows stay
    assert before.items() <= listing(tmp_path / "out").items()
    assert pq.read_table(tmp_path / "out" / "suite.parquet").equals(rows)
    table.write_text(TINY.replace("90.0", "60.0"))
    assert main(words) == 2
    assert "holds a suite of another scale or table" in capsys.readouterr().err


def test_a_scale_names_the_options_of_a_group_that_differ():
    world, own = {"bound": 1.0, "task": {"a": 1, "b": 2}}, {"task": {"b": 3}, "sizes": {"c": 4}}
    assert command._joined(world, own) == {"bound": 1.0, "task": {"a": 1, "b": 3}, "sizes": {"c": 4}}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bound =", "bounds =", "world correct of the table has 'bounds', did you mean 'bound'?"),
        ('"adapt"', '"adpat"', "world correct of the table has use 'adpat': give bootstrap or adapt"),
        ("fit_steps", "steps_fit", "names a field that does not exist"),
        ('says = "one"', "mistake_probability = 20", "teachers.one_cue.mistake_probability is 20"),
        ('says = "one"', "mistakes = 0.2", "names a field that does not exist"),
    ],
)
def test_a_mistake_in_a_table_is_told_before_a_cell_is_run(tmp_path, capsys, old, new, message):
    (table := tmp_path / "wrong.toml").write_text(TINY.replace(old, new))
    assert main(["suite", "--scale", "tiny", "--table", str(table), "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_process_ends_with_the_one_that_it_works_for(monkeypatch):
    with command._deadline(60.0) as is_over:
        for parent, ended in ((os.getppid(), False), (0, True)):
            monkeypatch.setenv(command.WORKS_FOR, str(parent))
            assert is_over() == ended


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scale", "smok"], "unknown scale 'smok'"),
        (["--minutes", "0"], "--minutes is 0"),
        (["--processes", "-1"], "--processes is -1"),
        (["--guidance", "nothing:HERE"], "nothing"),
        (["--table", "none.toml"], "--table none.toml cannot be read"),
    ],
)
def test_bad_input_is_one_line_and_changes_nothing(tmp_path, capsys, words, message):
    assert main(["suite", "--out", str(tmp_path / "out"), *words]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
