import errno
import importlib
import shutil

import pytest

from cuelearner_jax.cli import main

QUICK = ["sweep", "billiards", "--preset", "quickstart"]
WALK = ["evaluate", "navigation", "--policy", "uniform", "--task.worlds", "8", "--task.max-steps", "20"]
SHORT = "steps is 1200 for 120 environments, 10 each, but an episode lasts up to 20: give steps 2400"
WALKS = ["sweep", "navigation", "--preset", "quickstart", "--schedule.eval-envs", "10", "--schedule.eval-steps", "200"]

ARGUMENTS = [
    (["evalute"], "did you mean 'evaluate'"),
    (["sweep", "billards"], "did you mean 'billiards'"),
    (["sweep", "billiards", "--preset", "papr"], "did you mean 'paper'"),
    (["sweep", "billiards", "--preset"], "--preset: expected one argument"),
    ([*QUICK, "--seedz", "3"], "Perhaps you meant: --seeds"),
    ([*QUICK, "--task.table", "snooker"], "'one_ball', 'easy', 'regulation'"),
    ([*QUICK, "--guidance", "relativ"], "unknown guidance 'relativ', did you mean 'relative'"),
    ([*QUICK, "--seeds", "0"], "give --seeds"),
    ([*QUICK, "--schedule.total-steps", "1.5e0"], "1.5e0 is not a whole number"),
    ([*QUICK, "--agent", "sax"], "unknown agent 'sax', did you mean 'sac'"),
    (["train", "billiards", "--preset", "quickstart", "--agent", "sac"], "acts in boxes, not in directions: give"),
    (["evaluate", "nowhere"], "no run or policy folder, no task"),
    (["evaluate", "shipped:golf"], "no shipped agent 'shipped:golf': give one of shipped:arm, "),
    (["evaluate", "billiards", "--policy", "agent"], "needs a trained run"),
    (["evaluate", "billiards", "--compare", "nowhere"], "--compare is 'nowhere': give a run folder, a policy folder"),
    (["evaluate", "billiards", "--compare", "docs/data/navigation_agent"], "not of billiards: give one of billiards"),
    (["evaluate", "billiards", "--steps", "150"], "multiple of envs"),
    ([*WALK, "--steps", "1200", "--envs", "120"], SHORT),
    ([*WALK, "--steps", "10000", "--task.max-steps", "200"], "give steps 20000"),
    ([*WALK, "--episodes", "12", "--envs", "12"], "leave out steps and envs"),
    ([*WALK, "--episodes", "0"], "episodes is 0: give at least 1"),
    (["evaluate", "billiards", "--episodes", "3"], "billiards counts steps, not episodes: give --steps"),
    ([*WALKS, "--task.max-steps", "21"], "an episode lasts up to 21: give --schedule.eval-steps 210"),
    ([*WALKS, "--task.worlds", "0"], "task.worlds is 0: give a number from 1"),
    (["render", "billiards", "--film", "avi"], "gif or mp4"),
    (["evaluate", "billiards", "--task.table", "one_ball", "--policy", "teacher"], "--task.teacher search"),
    (["report", "--out", "report"], "no folder to report on"),
    (["report", "nowhere", "--out", "report"], "no results at or below"),
    (["report", "nowhere"], "give one of --out FOLDER and --json"),
]


@pytest.mark.parametrize(("command", "says"), ARGUMENTS, ids=[" ".join(c)[-40:] for c, _ in ARGUMENTS])
def test_bad_arguments_are_refused(refused, tmp_path, command, says):
    takes_out = command[0] in ("sweep", "train", "render") and len(command) > 2 and command[-1] != "--preset"
    refused([*command, *(["--out", tmp_path / "new"] if takes_out else [])], says, tmp_path)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("command", ["sweep billiards", "evaluate billiards", "report docs/data/navigation"])
def test_an_out_that_cannot_be_is_refused_before_any_work(refused, tmp_path, command):
    (tmp_path / "file").write_text("mine")
    says = "file is not a folder that may be written to: give another --out"
    refused([*command.split(), "--out", tmp_path / "file" / "run"], says, tmp_path)


@pytest.mark.parametrize(
    ("command", "advice"),
    [
        ("sweep billiards", "go on with the same command and --resume"),
        ("adapt runs/a", "give the same command again"),
        ("export runs/a", "give the same command again"),
        ("labels merge a.parquet", "give the same command again"),
    ],
)
def test_a_full_disk_advises_what_the_command_can_do(command, advice, capsys, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    name = command.split()[0]
    monkeypatch.setattr(importlib.import_module(f"cuelearner_jax.cli.{name}"), "run", full)
    assert main(command.split()) == 1
    assert capsys.readouterr().err.splitlines() == [f"error: the disk is full: free some, then {advice}"]


@pytest.fixture
def copy(run_folder, tmp_path):
    return shutil.copytree(run_folder, tmp_path / "copy")


@pytest.mark.parametrize("command", ["evaluate", "render"])
def test_what_is_no_run_is_refused(refused, copy, tmp_path, command):
    empty = tmp_path / "empty"
    empty.mkdir()
    out = ["--out", tmp_path / "new"]
    refused([command, empty, *out], "no config.json", tmp_path)
    refused([command, copy, "--policy", "expert", *out], "unknown policy", tmp_path)
    refused([command, copy, "--guidance", "scalar", *out], "choose among none, relative", tmp_path)
    (copy / "config.json").write_text("{")
    refused([command, copy, *out], "damaged", tmp_path)


def test_pictures_and_measurements_are_not_replaced_unasked(refused, copy, tmp_path):
    for name in ("copy-heuristic.gif", "measured.json"):
        (tmp_path / name).write_text("{}")
    refused(["render", copy, "--policy", "heuristic", "--out", tmp_path], "--overwrite", tmp_path)
    refused(["evaluate", copy, "--out", tmp_path / "measured.json"], "exists", tmp_path)
