"""A teacher of the user's own, from its training to the runs that it labels."""

import json
import shutil

import pytest
import train_teacher
from probes import edit_json
from small_runs import SMALL

from cuelearner_jax.cli import main

TINY = ["--teacher.layers", "16", "--teacher.tables", "8", "--teacher.rounds", "20", "--teacher.batch-size", "64"]
TINY += ["--teacher.search", "36", "--teacher.directions", "36", "--eval-steps", "20"]
RUN = ["train", "billiards", "--preset", "quickstart", *SMALL, "--guidance", "relative", "--labels", "10"]


@pytest.mark.long
def test_it_teaches_and_is_known_by_its_contents(refused, tmp_path):
    own, run, out, new = tmp_path / "teacher", tmp_path / "run", tmp_path / "measured.json", ["--out", tmp_path / "new"]
    assert train_teacher.main(["billiards", "--preset", "quickstart", *TINY, "--out", str(own)]) == 0
    command = [*RUN, "--task.teacher", str(own), "--out", str(run)]
    assert main(command) == 0
    described = json.loads((run / "config.json").read_text())
    assert described["task"]["teacher"] == str(own)
    assert len(described["files"]["teacher"]) == 12
    few = ["--steps", "20", "--envs", "10"]
    assert main(["evaluate", str(run), "--policy", "teacher", *few, "--out", str(out)]) == 0
    assert json.loads(out.read_text())["files"] == described["files"]
    refused([*RUN, "--task.teacher", own, "--task.table", "easy", *new], "learned with --task.table one", tmp_path)
    # Another teacher in the same place, one of another task, then none.
    edit_json(own / "teacher.json", lambda about: about.update(seed=7))
    refused([*command, "--resume"], "was run with other values of files.teacher", run)
    edit_json(own / "teacher.json", lambda about: about.update(task={"name": "navigation"}))
    refused([*RUN, "--task.teacher", own, *new], "is one of navigation, not of billiards", tmp_path)
    shutil.rmtree(own)
    refused(["evaluate", run, "--policy", "teacher", *few], f"no teacher in {own}: train one with", run)
    assert main(["evaluate", str(run), "--policy", "heuristic", *few]) == 0
