"""The second task through the same commands."""

import json
from pathlib import Path

import imageio.v2 as imageio
import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.records import results

SMALL = [
    *("--task.worlds", "8", "--task.max-steps", "20", "--sizes.q-layers", "16", "--sizes.feedback-layers", "16"),
    *("--sizes.directions", "12", "--sizes.n-step", "3", "--sizes.fit-steps", "20", "--sizes.batch-size", "16"),
    *("--schedule.total-steps", "200", "--schedule.eval-every", "100", "--schedule.checkpoint-every", "100"),
    *("--schedule.random-steps", "50", "--schedule.learn-after", "50", "--schedule.guidance-until", "200"),
    *("--schedule.eval-envs", "10", "--schedule.eval-steps", "200"),
]
OUTCOMES = ("success", "collision", "timeout")


@pytest.fixture(scope="module")
def walked(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "walked"
    command = ["sweep", "navigation", "--preset", "quickstart", *SMALL, "--seeds", "2", "--labels", "10"]
    assert main([*command, "--guidance", "relative", "--out", str(folder)]) == 0
    return folder


def test_every_evaluation_accounts_for_all_its_episodes(walked):
    rows = results.read(walked / "relative").to_pylist()
    assert [row["step"] for row in rows] == [0, 0, 100, 100, 200, 200]
    for row in rows:
        assert row["finished"] == 1  # 20 steps are time for each environment's first episode
        assert sum(row[name] for name in OUTCOMES) == pytest.approx(1)
        assert row["duration"] <= 4.0 + 1e-5  # 20 steps of 0.2 s


@pytest.mark.parametrize("policy", ["corrected", "teacher"])
def test_policies_are_evaluated_in_worlds_of_another_style(walked, tmp_path, policy):
    out = tmp_path / "measured.json"
    command = ["evaluate", str(walked), "--policy", policy, "--task.style", "rooms", "--task.max-steps", "200"]
    assert main([*command, "--envs", "8", "--steps", "1600", "--out", str(out)]) == 0
    measured = json.loads(out.read_text())
    assert measured["world"]["style"] == "rooms"
    for row in measured["rows"]:
        assert row["finished"] == [1] * len(row["seeds"])
        assert min(row["success"]) >= 0.75  # the road map's word, alone or as what refines the agent's actions


def test_a_report_of_successes(walked, tmp_path):
    out = tmp_path / "report"
    assert main(["report", str(walked), "--metric", "success", "--out", str(out)]) == 0
    assert imageio.imread(out / "curves.png").std() > 1
    assert "success" in (out / "report.md").read_text()


def test_an_episode_is_filmed(walked, tmp_path):
    command = ["render", str(walked), "--policy", "agent", "--guidance", "relative", "--steps", "6"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    assert imageio.imread(tmp_path / "walked-agent.png").std() > 1
    assert len(imageio.mimread(tmp_path / "walked-agent.gif")) >= 6


def test_a_task_without_a_world_is_refused(refused, tmp_path):
    command = ["sweep", "navigation", "--preset", "quickstart", *SMALL, "--out", str(tmp_path / "none")]
    refused([*command, "--task.worlds", "0"], "task.worlds is 0: give a whole number from 1", tmp_path)
