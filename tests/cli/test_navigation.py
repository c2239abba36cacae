"""The second task through the same commands."""

import json
from pathlib import Path

import imageio.v2 as imageio
import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.storage import results

SMALL = [
    *("--task.worlds", "8", "--task.max-steps", "20", "--agent.q-layers", "16", "--sizes.feedback-layers", "16"),
    *("--agent.directions", "12", "--agent.n-step", "3", "--sizes.fit-steps", "20", "--agent.batch-size", "16"),
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


@pytest.mark.long
def test_every_evaluation_accounts_for_all_its_episodes(walked):
    rows = results.read(walked / "relative").to_pylist()
    assert [row["step"] for row in rows] == [0, 0, 100, 100, 200, 200]
    for row in rows:
        assert row["finished"] == 1  # 20 steps are time for each environment's first episode
        assert sum(row[name] for name in OUTCOMES) == pytest.approx(1)
        assert row["duration"] <= 4.0 + 1e-5  # 20 steps of 0.2 s


@pytest.mark.long
@pytest.mark.parametrize("policy", ["corrected", "teacher"])
def test_policies_are_evaluated_in_worlds_of_another_style(walked, tmp_path, policy):
    out = tmp_path / "measured.json"
    command = ["evaluate", str(walked), "--policy", policy, "--task.style", "rooms", "--task.max-steps", "120"]
    assert main([*command, "--envs", "8", "--steps", "960", "--out", str(out)]) == 0
    measured = json.loads(out.read_text())
    assert measured["world"]["style"] == "rooms"
    for row in measured["rows"]:
        assert row["finished"] == [1] * len(row["seeds"])
        assert min(row["success"]) >= 0.75  # the road map's word, alone or as what refines the agent's actions


@pytest.mark.long
def test_an_evaluation_is_of_whole_episodes(walked, refused, tmp_path, capsys):
    """By default, by number, and never of the short ones alone."""
    evaluate = ["evaluate", str(walked), "--policy", "uniform"]
    for asked, episodes in ([], 100), (["--episodes", "12"], 12), (["--envs", "12"], 12):
        out = tmp_path / f"{len(asked)}{asked[:1]}.json"
        assert main([*evaluate, *asked, "--out", str(out)]) == 0
        assert f"uniform, {episodes} episodes a lane" in capsys.readouterr().out
        measured = json.loads(out.read_text())
        assert (measured["envs"], measured["steps"]) == (episodes, 20 * episodes)
        (row,) = measured["rows"]
        assert row["finished"] == [1]
        assert sum(row[name][0] for name in OUTCOMES) == pytest.approx(1)
        assert row["timeout"][0] > 0.2  # chance gets nowhere in 4 s
    short = "steps is 1200 for 120 environments, 10 each, but an episode lasts up to 20: give steps 2400"
    refused([*evaluate, "--steps", "1200", "--envs", "120"], short, tmp_path)
    refused([*evaluate, "--steps", "10000", "--task.max-steps", "200"], "give steps 20000", tmp_path)
    refused([*evaluate, "--episodes", "12", "--envs", "12"], "leave out steps and envs", tmp_path)
    refused([*evaluate, "--episodes", "0"], "from 1 to 100,000", tmp_path)
    refused(["evaluate", "billiards", "--episodes", "3"], "billiards counts steps, not episodes", tmp_path)
    cut = ["sweep", "navigation", "--preset", "quickstart", *SMALL, "--task.max-steps", "21"]
    refused([*cut, "--out", tmp_path / "cut"], "an episode lasts up to 21: give --schedule.eval-steps 210", tmp_path)


@pytest.mark.long
def test_a_report_of_successes(walked, tmp_path):
    out = tmp_path / "report"
    assert main(["report", str(walked), "--metric", "success", "--out", str(out)]) == 0
    assert imageio.imread(out / "curves.png").std() > 1
    assert "success" in (out / "report.md").read_text()


@pytest.mark.long
def test_an_episode_is_filmed(walked, tmp_path):
    command = ["render", str(walked), "--policy", "agent", "--guidance", "relative", "--steps", "6"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    assert imageio.imread(tmp_path / "walked-agent.png").std() > 1
    assert len(imageio.mimread(tmp_path / "walked-agent.gif")) >= 6


def test_a_task_without_a_world_is_refused(refused, tmp_path):
    command = ["sweep", "navigation", "--preset", "quickstart", *SMALL, "--out", str(tmp_path / "none")]
    refused([*command, "--task.worlds", "0"], "task.worlds is 0: give a whole number from 1", tmp_path)
