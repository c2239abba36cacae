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
    export = ["export", str(run_folder)]
    assert main([*export, "--format", "numpy", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "golden cases replayed" in said.out
    last = [row for row in results.read(run_folder).to_pylist() if row["step"] == 200]
    best = max(last, key=lambda row: row["reward"])
    assert f"seed {best['seed']}: the best of 6 lanes by the last recorded reward ({best['reward']:.4g})" in said.err
    told = json.loads((out / runner.CONTRACT).read_text())
    lane = {name: best[name] for name in results.LANE}
    assert {name: told["source"][name] for name in ("policy", *lane)} == {"policy": "agent", **lane}
    assert told["source"]["world"]["name"] == "bandit"
    assert [each["policy"] for each in layers(told["policy"])] == ["agent"]
    assert [each["unit"] for each in told["observation"]["slices"]] == ["1"]
    with np.load(out / runner.GOLDEN) as golden:
        obs, actions = golden["obs"], golden["actions"]
    own = load_policy(run_folder)
    assert own.lane == load_policy(run_folder, **lane).lane == lane
    np.testing.assert_allclose(own(obs), actions, atol=1e-5)
    assert main(["export", "--check", str(out)]) == 0
    assert "is unchanged since its export" in capsys.readouterr().out

    one = [word for name, value in lane.items() for word in (f"--{name}", str(value))]

    def no(command, says):
        refused([str(part) for part in command], says, tmp_path)

    no([*export, "--format", "numpy", "--out", out], "is not empty")
    no([*export, *one, "--policy", "guide", "--format", "numpy", "--out", tmp_path / "b"], "acts at random")
    no(["export", "--check", run_folder], "contract.json cannot be read")
