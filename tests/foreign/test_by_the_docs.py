"""A policy of PyTorch corrected by the commands of docs/logs.md; its correction is run by onnxruntime, without JAX."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import recorded_situations as recorded

from cuelearner_jax.cli import main
from cuelearner_jax.tasks import logs

torch = pytest.importorskip("torch")
pytest.importorskip("onnxruntime")

PAGE = (Path(__file__).resolve().parents[2] / "docs/logs.md").read_text()
COMMANDS = {
    line.split()[1]: shlex.split(line)[1:]
    for line in PAGE.splitlines()
    if re.match(r"cuelearner (label|adapt|eval|export)", line)
}
MODULE = """
import torch

torch.manual_seed(0)


class Arm(torch.nn.Module):
    def __init__(self):
        super().__init__()
        first, last = torch.nn.Linear(4, 16), torch.nn.Linear(16, 3)
        self.layers = torch.nn.Sequential(first, torch.nn.Tanh(), last, torch.nn.Tanh())

    def forward(self, obs):
        return self.layers(obs) * torch.tensor([0.3, 0.1, 0.6]) + torch.tensor([0.0, 0.2, 0.0])


POLICY = Arm()
"""
ALONE = """
import sys
import numpy as np, onnxruntime, torch
sys.path.insert(0, ".")
from my_arm import POLICY
session = onnxruntime.InferenceSession("exported/arm/decision.onnx", providers=["CPUExecutionProvider"])
obs = np.load("others.npy")
with torch.no_grad():
    base = POLICY.eval()(torch.as_tensor(obs)).numpy()
(action,) = session.run(["action"], {"obs": obs, "base_action": base})
np.savez("done.npz", base=base, action=action)
assert not {"jax", "cuelearner_jax"} & set(sys.modules)
"""
RANGE = np.array(recorded.HIGH) - np.array(recorded.LOW)
OFFSET = 0.12 * RANGE * np.array([1, -1, 1])  # by how much a person wants another action than the policy's
EPS = 0.05


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the policy and recorded situations in it, in which it acted; returns the policy."""
    (tmp_path / "my_arm.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_arm", raising=False)
    observations, _ = recorded.write(tmp_path / "situations", rows=150)
    from my_arm import POLICY

    table = tmp_path / "situations/situations.parquet"
    columns = pq.read_table(table).to_pydict()
    columns |= dict(zip((f"action.{name}" for name in recorded.ENTRIES), acted(POLICY, observations).T, strict=True))
    pq.write_table(pa.table(columns), table)
    return POLICY


def acted(policy, obs):
    """A module's actions."""
    with torch.no_grad():
        return policy.eval()(torch.as_tensor(np.asarray(obs, np.float32))).numpy()


def in_file(folder, policy, wanted, count, seed):
    """Writes a label file as the page does, about the policy's actions moved at random."""
    task = logs.task_of("situations", COMMANDS["label"][3], recorded.LOW, recorded.HIGH)
    space, random = logs.space_of(task.plain()), np.random.default_rng(seed)
    obs = random.uniform(-1, 1, (count, 4)).astype(np.float32)
    actions = np.clip(acted(policy, obs) + random.uniform(-0.2, 0.2, (count, 3)) * RANGE, recorded.LOW, recorded.HIGH)
    actions = actions.astype(np.float32)
    answers = recorded.said(space, actions, wanted(obs), EPS)
    recorded.write_labels(folder, task.plain(), space, EPS, (obs, actions, answers))


def test_the_commands_of_the_page_correct_a_policy_of_pytorch(place, tmp_path, capsys):
    policy = place
    wanted = lambda obs: np.clip(acted(policy, obs) + OFFSET, recorded.LOW, recorded.HIGH)  # noqa: E731
    in_file(Path("labels/arm"), policy, wanted, 150, 0)
    in_file(Path("labels/others"), policy, wanted, 60, 1)
    assert main(COMMANDS["adapt"]) == 0
    capsys.readouterr()
    assert main(COMMANDS["evaluate"]) == 0
    told = capsys.readouterr().out
    shares = {name: float(share) for name, share in re.findall(r"│ ([a-z ]+?) +│ ([0-9.-]+) ", told)}
    assert shares["the policy"] > shares["the policy as it was"] > 0
    assert main(COMMANDS["export"]) == 0
    assert main(["export", "--check", "exported/arm"]) == 0
    others = np.random.default_rng(5).uniform(-1, 1, (200, 4)).astype(np.float32)
    np.save("others.npy", others)
    subprocess.run([sys.executable, "-I", "-c", ALONE], check=True, cwd=tmp_path)
    with np.load("done.npz") as done:
        before, after = (np.abs((done[name] - wanted(others)) / RANGE).mean() for name in ("base", "action"))
    assert before == pytest.approx(0.12, abs=0.01)
    assert after < 0.5 * before
