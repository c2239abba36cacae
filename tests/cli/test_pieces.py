"""The policies of a sweep in pieces: taken together, and what is missing is said."""

import json
import shutil

import pytest
from probes import edit_json
from small_runs import SMALL

from cuelearner_jax.cli import main

SWEEP = ["sweep", "billiards", "--preset", "quickstart", *SMALL, "--seeds", "3", "--first-seed", "7"]
SWEEP += ["--guidance", "none"]


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory):
    """A sweep of three seeds, whole and in two pieces."""
    folder = tmp_path_factory.mktemp("sweeps")
    assert main([*SWEEP, "--out", str(folder / "whole")]) == 0
    for piece in ("1/2", "2/2"):
        assert main([*SWEEP, "--shard", piece, "--out", str(folder / "pieces")]) == 0
    return folder


@pytest.fixture
def pieces(sweeps, tmp_path):
    return shutil.copytree(sweeps / "pieces", tmp_path / "pieces")


@pytest.fixture
def measured(tmp_path, capsys):
    """Evaluates a folder: its rows, and what was told beside them."""

    def evaluate(folder):
        out = tmp_path / "measured.json"
        out.unlink(missing_ok=True)
        capsys.readouterr()
        assert main(["evaluate", str(folder), "--steps", "100", "--envs", "20", "--out", str(out)]) == 0
        return json.loads(out.read_text())["rows"], capsys.readouterr().err

    return evaluate


def test_pieces_are_evaluated_as_the_whole(sweeps, measured):
    whole, told = measured(sweeps / "whole")
    assert told == ""
    assert measured(sweeps / "pieces") == (whole, "")
    assert whole[0]["seeds"] == [7, 8, 9]


def test_a_piece_that_is_missing_is_named(pieces, measured, refused, tmp_path):
    whole, _ = measured(pieces)
    shutil.rmtree(pieces / "shard-2-of-2" / "none" / "checkpoints")
    rows, told = measured(pieces)
    assert told == f"{pieces / 'shard-2-of-2'}: no checkpoint of none guidance, left out\n"
    assert (rows[0]["seeds"], rows[0]["reward"]) == ([7, 8], whole[0]["reward"][:2])
    shutil.rmtree(pieces / "shard-2-of-2")
    rows, told = measured(pieces)
    assert told == f"{pieces}: shards not begun, of 2: 2\n"
    assert rows[0]["seeds"] == [7, 8]
    lane = ["render", pieces, "--seed", "9", "--out", tmp_path / "film"]
    assert main([str(part) for part in lane]) == 2
    shutil.rmtree(pieces / "shard-1-of-2" / "none" / "checkpoints")
    assert main(["evaluate", str(pieces)]) == 2


def test_pieces_at_other_steps_are_not_averaged(pieces, measured):
    shutil.rmtree(pieces / "shard-2-of-2" / "none" / "checkpoints" / "200")
    rows, told = measured(pieces)
    assert [(row["trained_steps"], row["seeds"]) for row in rows] == [(200, [7, 8]), (100, [9])]
    assert told == f"{pieces / 'shard-2-of-2'}: none guidance at step 100 of 200\n"


def test_pieces_of_different_sweeps_are_refused(pieces, refused):
    edit_json(pieces / "shard-2-of-2" / "config.json", lambda told: told["scalars"].update(eps_deg=3.0))
    refused(
        ["evaluate", pieces], "are shards of different sweeps (they differ in scalars.eps_deg): give the folder", pieces
    )
