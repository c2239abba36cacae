"""Labels of a recording on the command line: a policy corrected, judged and exported without a task or a simulator."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import recorded_situations as recorded
from small_runs import next_command

import cuelearner_jax as cl
from cuelearner_jax.cli import main
from cuelearner_jax.tasks import logs

NAME = "own_arm"
OWN = """
import numpy as np

def policy(obs):
    return obs[:, :3] * np.array([0.3, 0.1, 0.6]) + np.array([0.0, 0.2, 0.0])  # within the bounds
"""
EPS = 0.05
SIZES = ("--sizes.feedback-layers", "8", "--sizes.fit-steps", "20", "--sizes.fit-batch-size", "20")
SMALL = ("--guidance", "relative", *SIZES)


@pytest.fixture(scope="module")
def place(home):
    """Where recorded situations lie, and labels that ask for more of each entry."""
    folder = home
    recorded.write(folder / "situations", pictures=False)
    task = logs.task_of(folder / "situations", "left,right;up,down;open,close", recorded.LOW, recorded.HIGH)
    space, random = logs.space_of(task.plain()), np.random.default_rng(0)
    obs = random.uniform(-1, 1, (40, 4)).astype(np.float32)
    namespace = {}
    exec(OWN, namespace)
    actions = namespace["policy"](obs).astype(np.float32)
    best = np.clip(actions + 0.1, recorded.LOW, recorded.HIGH).astype(np.float32)
    answers = recorded.said(space, actions, best, EPS)
    recorded.write_labels(folder / "labels", task.plain(), space, EPS, (obs, actions, answers))
    return folder


pytestmark = pytest.mark.usefixtures("place", "there")


def test_a_policy_of_code_is_corrected_judged_and_exported(capsys):
    adapt = ["adapt", "own_arm:policy", "--labels-from", "labels", "--bound-deg", "0.2", *SMALL]
    assert main([*adapt, "--out", "policies/arm"]) == 0
    told = capsys.readouterr().out
    assert "40 labels within 0.2 shares: predicts" in told
    assert main(["labels" if word == "OTHER_LABELS" else word for word in next_command(told)]) == 0
    told = capsys.readouterr().out
    for words in ("agreement with 40 labels", "the policy as it was", "always already right", "difference from"):
        assert words in told
    assert main(["evaluate", "own_arm:policy", "--labels-from", "labels"]) == 0
    assert "own_arm:policy: agreement with 40 labels of labels" in capsys.readouterr().out
    assert main(["export", "policies/arm", "--only-correction", "--format", "numpy", "--out", "exported"]) == 0
    import own_arm

    obs = recorded.arrays()[0]
    better = cl.load_policy("policies/arm", base=own_arm.policy)
    np.testing.assert_allclose(cl.load_exported("exported")(obs, own_arm.policy(obs)), better(obs), atol=1e-5)
    assert main(["export", "policies/arm", "--format", "numpy", "--base", "own_arm:policy", "--out", "no"]) == 2
    assert "or export the correction alone (--only-correction" in capsys.readouterr().err


def test_proposed_actions_are_corrected_by_their_labels_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    observations, actions = recorded.arrays(40)
    phase = np.linspace(0, 1, 40)
    (tmp_path / "proposed").mkdir()
    columns = {"observation": list(observations), "action": list(actions), "phase": phase}
    pq.write_table(pa.table(columns), tmp_path / "proposed/situations.parquet")
    task = logs.task_of("proposed", "left,right;up,down;open,close", recorded.LOW, recorded.HIGH)
    env = task.environment(task.plain())
    obs, asked = np.asarray(env.rows), np.asarray(env.recorded)
    more = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (40, 1))
    recorded.write_labels(tmp_path / "labels", task.plain(), env.actions, EPS, (obs, asked, more))
    assert main(["adapt", "--labels-from", "labels", "--out", "better"]) == 0
    assert "action: " in capsys.readouterr().out
    moved = np.asarray(cl.load_policy("better")(obs)) - asked
    assert np.median(moved[:, 0]) > EPS
    np.testing.assert_allclose(moved[:, 1:], 0, atol=0.02)
