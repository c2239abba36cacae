"""The quickstart preset learns to reach, and what it has learned acts in Fetch."""

import json

import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.storage import results


@pytest.mark.long
def test_sac_learns_to_reach_and_acts_in_fetch(tmp_path):
    pytest.importorskip("gymnasium_robotics")
    run, file = tmp_path / "run", tmp_path / "fetch.json"
    command = ["train", "arm", "--preset", "quickstart", "--task.skill", "reach", "--guidance", "none"]
    command += ["--schedule.total-steps", "12800", "--schedule.eval-every", "12800", "--schedule.guidance-until", "0"]
    assert main([*command, "--schedule.checkpoint-every", "12800", "--out", str(run)]) == 0
    first, last = results.read(run).to_pylist()
    assert first["success"] <= 0.1
    assert last["success"] >= 0.9
    assert main(["evaluate", str(run), "--robot", "fetch", "--episodes", "20", "--out", str(file)]) == 0
    (row,) = json.loads(file.read_text())["rows"]
    assert row["success"][0] >= 0.9
