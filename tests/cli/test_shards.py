"""Sweeps in pieces: each alone gives what the whole gives, begun twice, killed, or on a full disk."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_runs import SMALL, rows

from cuelearner_jax.cli import main
from cuelearner_jax.runs.shards import Shard

ENTRY = [str(Path(sys.executable).with_name("cuelearner"))]
SWEEP = ["sweep", "billiards", "--preset", "quickstart", *SMALL, "--seeds", "3", "--first-seed", "7"]
SWEEP += ["--guidance", "none"]
TESTS = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main([*SWEEP, "--out", str(folder)]) == 0
    return rows(folder)


def test_pieces_are_equal_shares_that_make_the_whole():
    seeds = tuple(range(20, 31))
    shares = [Shard(index, 4).seeds(seeds) for index in range(1, 5)]
    assert sum(shares, ()) == seeds
    assert sorted(len(share) for share in shares) == [2, 3, 3, 3]
    assert Shard.parse("3/12").folder(Path("runs")) == Path("runs/shard-03-of-12")


@pytest.mark.parametrize("text", ["0/4", "5/4", "3", "a/b", "1/0", "-1/2", "1/2/3"])
def test_what_is_no_piece_is_refused(refused, tmp_path, text):
    refused([*SWEEP, f"--shard={text}", "--out", tmp_path / "run"], "give i/n with i from 1 to n", tmp_path)


def test_more_pieces_than_seeds_are_refused(refused, tmp_path):
    refused([*SWEEP, "--shard", "1/4", "--out", tmp_path / "run"], "3 seeds cannot be divided into 4 shards", tmp_path)


def test_pieces_give_what_the_whole_gives_and_a_report_says_which_are_missing(whole, tmp_path, capsys):
    out = tmp_path / "run"
    assert main([*SWEEP, "--shard", "1/2", "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["shard-1-of-2"]
    assert main(["report", str(out), "--out", str(tmp_path / "half")]) == 0
    assert "shards not begun, of 2: 2" in (tmp_path / "half" / "report.md").read_text()
    assert main([*SWEEP, "--shard", "2/2", "--out", str(out)]) == 0
    assert rows(out) == whole
    assert main(["report", str(out), "--out", str(tmp_path / "both")]) == 0
    text = (tmp_path / "both" / "report.md").read_text()
    assert "not begun" not in text
    assert "differ in more than" not in text
    assert "| none | 0 | 3 |" in text
    before = {path: path.stat().st_mtime_ns for path in out.rglob("results.parquet")}
    assert main([*SWEEP, "--shard", "2/2", "--out", str(out)]) == 0  # finished: left as it is
    assert "finished before" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in out.rglob("results.parquet")} == before


def test_a_piece_that_was_copied_over_another_is_not_counted_twice(whole, refused, tmp_path):
    out = tmp_path / "run"
    assert main([*SWEEP, "--shard", "1/2", "--out", str(out)]) == 0
    shutil.copytree(out / "shard-1-of-2", out / "shard-2-of-2")
    refused(["evaluate", out, "--guidance", "none"], "both hold seed 7: delete the one that is a copy", out)


def test_other_options_for_a_piece_that_has_begun_are_refused(refused, tmp_path):
    command = [*SWEEP, "--shard", "3/3", "--out", tmp_path / "run"]
    assert main([str(part) for part in command]) == 0
    refused([*command, "--scalars.eps-deg", "3"], "was run with other values of scalars.eps_deg", tmp_path)
    second = [*SWEEP, "--shard", "2/3", "--out", tmp_path / "run"]
    refused([*second, "--scalars.eps-deg", "3"], "is a shard of a sweep with another scalars.eps_deg", tmp_path)
    refused([*second, "--seeds", "4"], "is a shard of a sweep with another shard.seeds: give the same", tmp_path)


@pytest.mark.long
def test_a_piece_that_was_killed_goes_on_with_the_same_command(tmp_path, capsys):
    command = [*SWEEP, "--schedule.total-steps", "1000", "--shard", "1/2"]
    calm, killed = tmp_path / "calm", tmp_path / "killed"
    assert main([*command, "--out", str(calm)]) == 0
    process = subprocess.Popen([*ENTRY, *command, "--out", str(killed)], stderr=subprocess.DEVNULL)
    written = killed / "shard-1-of-2" / "none" / "results.jsonl"
    for _ in range(1200):
        if written.exists() and '"step": 300' in written.read_text():
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGSTOP)  # it lives, and holds its folder
    capsys.readouterr()
    twice = main([*command, "--out", str(killed)])
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert twice == 2
    assert "is being written by another process" in capsys.readouterr().err
    assert main([*command, "--out", str(killed)]) == 0
    assert rows(killed) == rows(calm)


def test_a_table_that_the_disk_has_no_room_for_is_reported(tmp_path):
    # Every file but the shortest is too large for this process.
    script = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000));"
    script += "from cuelearner_jax.cli import main; sys.exit(main(sys.argv[1:]))"
    bandit = ["sweep", "page_task:TASK", "--guidance", "none", "--seeds", "2"]  # whose programs are soon compiled
    command = [sys.executable, "-c", script, *bandit, "--out", str(tmp_path / "run")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path])}
    env["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # JAX warns of programs that it can't keep
    env["PYTHONDONTWRITEBYTECODE"] = "1"  # Python keeps a compiled module that was cut, for all who import it later
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 1
    # Orbax's threads may complain beside it.
    assert "error: the disk is full: free some, then go on with the same command and --resume" in done.stderr
