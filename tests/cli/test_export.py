"""`cuelearner export` as it is typed: what it writes, what it checks, what it refuses."""

import json
from functools import partial

import numpy as np

from cuelearner_jax.api.policies import load_policy
from cuelearner_jax.cli import main
from cuelearner_jax.export import contract, decisions, runner
from cuelearner_jax.policies import layers
from cuelearner_jax.storage import results


def test_a_runs_agent_is_exported_and_checked(run_folder, refused, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(contract, "golden_cases", partial(decisions.golden_cases, most=6))  # NumPy takes a second each
    out = tmp_path / "new" / "decision"
    export = ["export", str(run_folder), "--guidance", "relative", "--labels", "20", "--seed", "2001"]
    assert main([*export, "--format", "numpy", "--out", str(out)]) == 0
    assert "golden cases replayed" in capsys.readouterr().out
    told = json.loads((out / runner.CONTRACT).read_text())
    assert told["source"]["policy"] == "agent"
    assert [told["source"][part] for part in ("guidance", "labels", "seed")] == ["relative", 20, 2001]
    assert told["source"]["world"]["name"] == "billiards"
    assert [each["policy"] for each in layers(told["policy"])] == ["agent"]
    assert [each["unit"] for each in told["observation"]["slices"][:2]] == ["m", "1"]
    with np.load(out / runner.GOLDEN) as golden:
        obs, actions = golden["obs"], golden["actions"]
    own = load_policy(run_folder, guidance="relative", labels=20, seed=2001)
    rows = [row for row in results.read(run_folder).to_pylist() if row["step"] == 200]
    best = max(rows, key=lambda row: row["reward"])
    lane = load_policy(run_folder).lane
    assert lane == (best["guidance"], best["labels"], (best["seed"],))
    assert f"{lane[0]}, {lane[1]} labels, seed {lane[2][0]} has the best" in capsys.readouterr().err
    np.testing.assert_allclose(own(obs), actions, atol=1e-5)
    assert main(["export", "--check", str(out)]) == 0
    assert "is unchanged since its export" in capsys.readouterr().out

    def no(command, says):
        refused([str(part) for part in command], says, tmp_path)

    no([*export, "--format", "numpy", "--out", out], "is not empty")
    no([*export, "--format", "torch", "--out", tmp_path / "b"], "unknown format 'torch'")
    no(["export", run_folder, "--policy", "guide", "--format", "numpy", "--out", tmp_path / "b"], "acts at random")
    no(["export", run_folder, "--policy", "teacher", "--format", "numpy", "--out", tmp_path / "b"], "asks the teacher")
    no(["export", run_folder, "--seed", "5", "--format", "numpy", "--out", tmp_path / "b"], "no lane with seed 5")
    no(["export", "--check", run_folder], "contract.json cannot be read")
    golden = out / runner.GOLDEN
    golden.write_bytes(golden.read_bytes()[:-1])
    no(["export", "--check", out], "is not the file that was exported")
