"""`cuelearner export` as it is typed: what it writes, what it checks, what it refuses."""

import json
from functools import partial

import numpy as np

from cuelearner_jax.api.policies import load_policy
from cuelearner_jax.cli import main
from cuelearner_jax.export import contract, decisions, runner
from cuelearner_jax.policies import layers


def test_a_runs_agent_is_exported_and_checked(run_folder, refused, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(contract, "golden_cases", partial(decisions.golden_cases, most=6))  # NumPy takes a second each
    out = tmp_path / "new" / "decision"
    export = ["export", str(run_folder), "--seed", "2001"]
    assert main([*export, "--format", "numpy", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "golden cases replayed" in said
    assert "lane of guidance relative, labels 20, seed 2001" in said  # by default the last kind, the largest budget
    told = json.loads((out / runner.CONTRACT).read_text())
    lane = {name: told["source"][name] for name in ("policy", "guidance", "labels", "seed")}
    assert lane == {"policy": "agent", "guidance": "relative", "labels": 20, "seed": 2001}
    assert told["source"]["world"]["name"] == "bandit"
    assert [each["policy"] for each in layers(told["policy"])] == ["agent"]
    assert [each["unit"] for each in told["observation"]["slices"]] == ["1"]
    with np.load(out / runner.GOLDEN) as golden:
        obs, actions = golden["obs"], golden["actions"]
    own = load_policy(run_folder, guidance="relative", labels=20, seed=2001)
    np.testing.assert_allclose(own(obs), actions, atol=1e-5)
    assert main(["export", "--check", str(out)]) == 0
    assert "is unchanged since its export" in capsys.readouterr().out

    def no(command, says):
        refused([str(part) for part in command], says, tmp_path)

    no([*export, "--format", "numpy", "--out", out], "is not empty")
    no(["export", run_folder, "--policy", "guide", "--format", "numpy", "--out", tmp_path / "b"], "acts at random")
    no(["export", "--check", run_folder], "contract.json cannot be read")
    golden = out / runner.GOLDEN
    golden.write_bytes(golden.read_bytes()[:-1])
    no(["export", "--check", out], "is not the file that was exported")
