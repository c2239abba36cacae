"""An exported navigation policy at work: in C MuJoCo, and behind a ROS 2 node's messages."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np
import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.export import contract, decisions
from examples import ros2_node

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def walker(tmp_path_factory):
    out = tmp_path_factory.mktemp("walker") / "numpy"
    agent = str(ROOT / "docs" / "data" / "navigation_agent")
    with pytest.MonkeyPatch.context() as patch:  # NumPy takes a second for each golden case
        patch.setattr(contract, "golden_cases", partial(decisions.golden_cases, most=3))
        assert main(["export", agent, "--format", "numpy", "--task.worlds", "2", "--out", str(out)]) == 0
    return out


def test_the_policy_crosses_a_hall_in_mujoco_without_jax(walker):
    """As its docstring tells, in a process of its own, which fails where JAX was loaded."""
    command = [sys.executable, "examples/exported_in_mujoco.py", str(walker)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("goal after")


def scan(count=541, around=3 * np.pi / 2, distance=4.0):
    angles = np.linspace(-around / 2, around / 2, count)
    return Message(
        angle_min=angles[0], angle_increment=angles[1] - angles[0], range_min=0.05, ranges=np.full(count, distance)
    )


def odometry(x, y, yaw):
    turn = Message(x=0.0, y=0.0, z=np.sin(yaw / 2), w=np.cos(yaw / 2))
    return Message(pose=Message(pose=Message(position=Message(x=x, y=y), orientation=turn)))


def goal(x, y):
    return Message(pose=Message(position=Message(x=x, y=y)))


class Recorded:
    """In place of the decision: always a quarter turn to the left, and what it was shown."""

    def __init__(self, contract):
        self.contract, self.shown = contract, []

    def __call__(self, obs):
        self.shown.append(obs)
        return np.array([0.0, 1.0], np.float32)


def test_the_node_shows_what_the_contract_says_and_holds_the_direction_in_the_world(walker):
    walk = ros2_node.Walk(walker)
    walk.decide = decide = Recorded(walk.decide.contract)
    heard = scan()
    heard.ranges[:10] = np.inf
    heard.ranges[-1] = 0.01  # nearer than the sensor can measure
    walk.hear_scan(heard, 10.0)
    walk.hear_odometry(odometry(1.0, 2.0, np.pi / 2), 10.0)
    assert walk.command(10.0) == (0.0, 0.0, 0.0)
    walk.step(10.0)
    assert decide.shown == []  # there is no goal
    walk.hear_goal(goal(1.0, 5.0))  # 3 m straight ahead
    walk.step(10.0)
    (obs,) = decide.shown
    np.testing.assert_allclose(obs[:4], np.exp(-10.0), atol=1e-6)
    np.testing.assert_allclose(obs[10:270], np.exp(-4.0), rtol=1e-5)
    assert obs[270] == pytest.approx(np.exp(-10.0), abs=1e-6)
    np.testing.assert_allclose(obs[271:274], [1.0, 0.0, 0.2], atol=1e-6)
    np.testing.assert_array_equal(obs[274:], 0.0)
    np.testing.assert_allclose(walk.command(10.1), [0.0, 1.0, 1.5], atol=1e-6)
    walk.hear_odometry(odometry(1.0, 2.0, np.pi / 2 + 0.3), 10.1)  # the body has turned under the command
    np.testing.assert_allclose(walk.command(10.1), [np.sin(0.3), np.cos(0.3), 1.5], atol=1e-6)
    walk.hear_scan(scan(), 10.2)
    walk.step(10.2)
    np.testing.assert_allclose(decide.shown[1][274:], [0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    assert walk.command(10.75) == (0.0, 0.0, 0.0)  # what was heard is stale
    walk.hear_odometry(odometry(1.0, 4.7, 0.0), 10.4)
    walk.step(10.4)
    assert walk.command(10.4) == (0.0, 0.0, 0.0)  # arrived
    assert len(decide.shown) == 2
