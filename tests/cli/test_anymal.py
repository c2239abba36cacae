"""The quadruped's commands: walking policies, other robots and engines for a trained agent."""

import json
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from cuelearner_envs.anymal import model, policy
from cuelearner_envs.anymal.scene import Studio
from cuelearner_jax.cli import main
from cuelearner_jax.errors import UserError

AGENT = Path(__file__).parents[2] / "docs" / "data" / "navigation_agent"

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


@pytest.fixture
def opengl():
    """Skips where MuJoCo can't render."""
    try:
        with Studio(model.load(), 32, 32):
            pass
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.long
def test_its_episodes_are_filmed_from_above_and_from_the_side(opengl, tmp_path):
    command = ["render", str(AGENT), "--robot", "anymal", "--steps", "2", "--task.worlds", "8", "--out", str(tmp_path)]
    assert main(command) == 0
    pictures = imageio.mimread(tmp_path / "navigation_agent-anymal-agent.gif")
    assert len(pictures) == 4  # 0.4 s at 10 a second
    height, width = pictures[0].shape[:2]
    assert width == 2 * height
    for half in np.split(pictures[0][..., :3], 2, axis=1):
        assert half.std() > 10
    assert imageio.imread(tmp_path / "navigation_agent-anymal-agent.png").std() > 10
