"""Sweeps in pieces: together they are the whole; begun twice, stopped, on a full disk, and with a piece missing."""

import json
import shutil
from pathlib import Path

import pytest
from probes import edit_json
from small_runs import BANDIT, listing, rows

from cuelearner_jax.cli import main
from cuelearner_jax.errors import UserError
from cuelearner_jax.runs.shards import Shard

SWEEP = ["sweep", BANDIT, "--seeds", "7:10", "--guidance", "none"]


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


def test_pieces_are_equal_shares_that_make_the_whole():
    seeds = tuple(range(20, 31))
    shares = [Shard(index, 4).seeds(seeds) for index in range(1, 5)]
    assert sum(shares, ()) == seeds
    assert sorted(len(share) for share in shares) == [2, 3, 3, 3]
    assert Shard.parse("3/12").folder(Path("runs")) == Path("runs/shard-03-of-12")
    for text in ("0/4", "5/4", "3", "a/b", "1/0", "-1/2", "1/2/3"):
        with pytest.raises(UserError, match="give i/n with i from 1 to n"):
            Shard.parse(text)


def test_pieces_are_trained_evaluated_and_reported_as_the_whole(sweeps, measured, tmp_path, capsys):
    pieces, whole = sweeps / "pieces", sweeps / "whole"
    assert sorted(path.name for path in pieces.iterdir()) == ["shard-1-of-2", "shard-2-of-2"]
    assert rows(pieces) == rows(whole)
    found, told = measured(whole)
    assert (found[0]["seeds"], told) == ([7, 8, 9], "")
    assert measured(pieces) == (found, "")
    assert main(["report", str(pieces), "--out", str(tmp_path / "report")]) == 0
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| none | 0 | 3 |" in text
    assert "not begun" not in text
    assert "differ in more than" not in text
    before = listing(pieces)
    assert main([*SWEEP, "--shard", "2/2", "--out", str(pieces)]) == 0  # finished: left as it is
    assert "finished before" in capsys.readouterr().err
    assert listing(pieces) == before


def test_a_piece_that_is_missing_is_named(pieces, measured, tmp_path):
    second = pieces / "shard-2-of-2"
    whole, _ = measured(pieces)
    shutil.rmtree(second / "none" / "checkpoints" / "200")
    found, told = measured(pieces)  # of other steps: not averaged
    assert [(row["trained_steps"], row["seeds"]) for row in found] == [(200, [7, 8]), (100, [9])]
    assert told == f"{second}: none guidance at step 100 of 200\n"
    shutil.rmtree(second / "none" / "checkpoints")
    found, told = measured(pieces)
    assert told == f"{second}: no checkpoint of none guidance, left out\n"
    assert (found[0]["seeds"], found[0]["reward"]) == ([7, 8], whole[0]["reward"][:2])
    shutil.rmtree(second)
    found, told = measured(pieces)
    assert (found[0]["seeds"], told) == ([7, 8], f"{pieces}: shards not begun, of 2: 2\n")
    assert main(["report", str(pieces), "--out", str(tmp_path / "report")]) == 0
    assert "shards not begun, of 2: 2" in (tmp_path / "report" / "report.md").read_text()
    assert main(["render", str(pieces), "--seed", "9", "--out", str(tmp_path / "film")]) == 2
    shutil.rmtree(pieces / "shard-1-of-2" / "none" / "checkpoints")
    assert main(["evaluate", str(pieces)]) == 2


def test_pieces_that_do_not_fit_together_are_refused(pieces, refused, tmp_path):
    refused([*SWEEP, "--shard", "1/4", "--out", tmp_path / "run"], "3 seeds cannot be divided into 4 shards", tmp_path)
    half = pieces / "shard-1-of-2"
    refused(["evaluate", pieces, "--seed", "9", "--compare", half], f"{half} has no lane with seed 9", pieces)
    other = ["--scalars.eps-deg", "3"]
    first, second = ([*SWEEP, "--shard", piece, "--out", pieces] for piece in ("1/2", "2/2"))
    shutil.rmtree(pieces / "shard-2-of-2")
    refused([*first, *other], "was run with other values of scalars.eps_deg", pieces)
    refused([*second, *other], "is a shard of a sweep with another scalars.eps_deg", pieces)
    refused([*second, "--seeds", "4"], "is a shard of a sweep with another shard.seeds: give the same", pieces)
    shutil.copytree(pieces / "shard-1-of-2", pieces / "shard-2-of-2")
    says = "both hold seed 7: delete the one that is a copy"
    refused(["evaluate", pieces, "--guidance", "none"], says, pieces)
    edit_json(pieces / "shard-2-of-2" / "config.json", lambda told: told["scalars"].update(eps_deg=3.0))
    says = "are shards of different sweeps (they differ in scalars.eps_deg): give the folder"
    refused(["evaluate", pieces], says, pieces)
