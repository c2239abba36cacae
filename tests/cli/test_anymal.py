"""The quadruped's commands: walking policies, other robots and engines for a trained agent."""

import json
import shutil

import pytest
from probes import edit_json

from cuelearner_envs.anymal import policy
from cuelearner_jax.cli import main
from cuelearner_jax.studies import evaluate

REFUSED = [
    (["evaluate", "billiards", "--robot", "anymal"], "billiards has no robots to choose from: leave out --robot"),
    (["train", "navigation", "--robot", "anymall", "--out", "run"], "unknown robot 'anymall', did you mean 'anymal'"),
    (["sweep", "navigation", "--robot", "anymal:own", "--out", "run"], "training takes no folder of a robot: give its"),
    (["render", "arm", "--robot", "fetch"], "arm has no pictures of fetch: evaluate it instead"),
    (["evaluate", "navigation", "--robot", "anymal:nowhere"], "no walking policy in nowhere: train one with"),
    (["render", "navigation", "--robot", "simple:nowhere"], "simple takes no folder: leave out 'nowhere'"),
]


@pytest.mark.parametrize(("command", "says"), REFUSED, ids=[" ".join(command)[-40:] for command, _ in REFUSED])
def test_bad_combinations_are_refused(refused, tmp_path, monkeypatch, command, says):
    monkeypatch.chdir(tmp_path)
    refused(command, says, tmp_path)


def test_policies_of_two_robots_are_compared_on_one(tmp_path, monkeypatch):
    other, robots = shutil.copytree("docs/data/navigation_agent", tmp_path / "other"), []
    edit_json(other / "config.json", lambda values: values.update(robot="anymal"))
    prepare = lambda source, request: robots.append(source.task.bodies[0].name) or (None, [])  # noqa: E731
    monkeypatch.setattr(evaluate, "prepare", prepare)
    assert main(["evaluate", "shipped:navigation", "--compare", str(other)]) == 0
    assert robots == ["simple", "simple"]


def test_it_walks_by_a_policy_of_the_users_own(tmp_path):
    """The shipped one in another place, then one that lets the robot fall."""
    own, rows = tmp_path / "own", []
    shipped = policy.load()
    limp = shipped.replace(layers=tuple((0 * kernel - 1, 0 * bias - 1) for kernel, bias in shipped.layers))
    for number, one in enumerate((shipped, limp)):
        policy.save(own, one, {})
        out = tmp_path / f"{number}.json"
        command = ["evaluate", "navigation", "--robot", f"anymal:{own}", "--engine", "mujoco", "--task.worlds", "8"]
        assert main([*command, "--task.max-steps", "4", "--episodes", "2", "--out", str(out)]) == 0
        rows.append(json.loads(out.read_text()))
    assert [row["robot"] for row in rows] == [f"anymal:{own}"] * 2
    assert len({row["robot_digest"] for row in rows}) == 2
    assert [row["rows"][0]["fall"] for row in rows] == [[0.0], [1.0]]
