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


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Where a tiny teacher of one ball lies."""
    folder = tmp_path_factory.mktemp("own") / "teacher"
    assert train_teacher.main(["billiards", "--preset", "quickstart", *TINY, "--out", str(folder)]) == 0
    return folder


@pytest.mark.long
def test_a_tiny_teacher_is_trained(trained):
    told = json.loads((trained / "teacher.json").read_text())
    assert told["command"].startswith("python experiments/train_teacher.py billiards")
    assert {path.name for path in trained.iterdir()} == {"network", "teacher.json"}


@pytest.mark.long
def test_it_teaches_and_is_known_by_its_contents(trained, refused, tmp_path):
    own, run, out = tmp_path / "teacher", tmp_path / "run", tmp_path / "measured.json"
    shutil.copytree(trained, own)
    command = [*RUN, "--task.teacher", str(own), "--out", str(run)]
    assert main(command) == 0
    described = json.loads((run / "config.json").read_text())
    assert described["task"]["teacher"] == str(own)
    assert len(described["files"]["teacher"]) == 12
    few = ["--steps", "20", "--envs", "10"]
    assert main(["evaluate", str(run), "--policy", "teacher", *few, "--out", str(out)]) == 0
    assert json.loads(out.read_text())["files"] == described["files"]
    # Another teacher in the same place, then none.
    edit_json(own / "teacher.json", lambda about: about.update(seed=7))
    refused([*command, "--resume"], "was run with other values of files.teacher", run)
    shutil.rmtree(own)
    refused([*command, "--resume"], f"no teacher in {own}", run)
    for policy in ("teacher", "corrected"):
        refused(["evaluate", run, "--policy", policy, *few], f"no teacher in {own}: train one with", run)
    refused(["render", run, "--policy", "teacher", "--out", tmp_path / "film"], "--task.teacher search", tmp_path)
    assert main(["evaluate", str(run), "--policy", "heuristic", *few]) == 0


@pytest.mark.long
def test_a_teacher_that_does_not_fit_is_refused(trained, refused, tmp_path):
    new = ["--out", tmp_path / "new"]
    refused([*RUN, "--task.teacher", tmp_path / "nowhere", *new], "give its folder (--task.teacher FOLDER)", tmp_path)
    refused([*RUN, "--task.teacher", trained, "--task.table", "easy", *new], "learned with --task.table one", tmp_path)
    refused([*RUN, "--task.teacher", trained, "--task.acceleration", "0", "0.05", *new], "this world's", tmp_path)
    navigation = tmp_path / "navigation"
    shutil.copytree(trained, navigation)
    edit_json(navigation / "teacher.json", lambda about: about.update(task={"name": "navigation"}))
    refused([*RUN, "--task.teacher", navigation, *new], "is one of navigation, not of billiards", tmp_path)
    steep = ["evaluate", "billiards", "--preset", "easy", "--policy", "teacher", "--task.acceleration", "0", "0.05"]
    refused(steep, "does not know this world's --task.acceleration 0.0 0.05: use the search teacher", tmp_path)
