"""The example of a space of one's own: laws, a guide fitted in it, adaptation, a decision exported, a page's words."""

import contextlib
import json
import shlex
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.export import runner
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.labelling import controls
from cuelearner_jax.spaces import from_json
from cuelearner_jax.storage import results
from cuelearner_jax.tasks import registry
from cuelearner_jax.testing import check_environment, check_space, check_task
from examples.wrist import TASK, WRIST, LidConfig, Lids

pytestmark = pytest.mark.long
ROOT = Path(__file__).resolve().parents[2]
SMALL = shlex.split("""
    --agent.q-layers 16 --sizes.feedback-layers 32 32 --agent.directions 64 --schedule.total-steps 200
    --schedule.guidance-until 100 --schedule.eval-every 200 --schedule.eval-steps 400 --schedule.checkpoint-every 200
""")


@pytest.fixture(autouse=True)
def there(monkeypatch):
    """In the folder above the examples; the task is known in this test alone."""
    monkeypatch.chdir(ROOT)
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.setattr(registry, "_registered", dict(registry._registered))


def test_the_wrist_keeps_the_laws_and_wraps():
    check_space(WRIST)
    check_environment(Lids(0.1))
    check_task(TASK, LidConfig())
    just_left, just_right = (WRIST._rolled(jnp.array([turn, 0.5])) for turn in (0.95, -0.95))
    np.testing.assert_allclose(WRIST.log(just_left, just_right), [0.1, 0.0], atol=1e-6)  # not -1.9
    opened = WRIST.exp(just_left, jnp.array([0.0, 0.9]))
    assert float(opened[2]) == 1.0  # no farther than it goes
    assert from_json(WRIST.to_json()) == WRIST
    words = [control.words for control in controls.answers(RELATIVE, WRIST) if control.cue == 1]
    assert words == ["open", "already right", "close", "not said"]


NAMED = ["--task", "examples.wrist:TASK"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run in this space."""
    folder = str(tmp_path_factory.mktemp("wrist") / "run")
    with contextlib.chdir(ROOT):
        options = ["--preset", "quickstart", *SMALL, "--labels", "200", "--out", folder]
        assert main(["train", "examples.wrist:TASK", *options]) == 0
    return folder


def test_labels_lead_a_wrist_and_a_gripper_to_lids(run):
    measured = results.read_guides([run])
    assert measured is not None
    assert measured["guide_turned"].to_pylist()[-1] > 0.5  # by chance 0.02


@pytest.mark.long
def test_a_policy_in_a_space_of_ones_own_is_exported_and_adapted(run, tmp_path, capsys):
    decision = tmp_path / "decision"
    assert main(["export", run, *NAMED, "--format", "numpy", "--out", str(decision)]) == 0
    told = json.loads((decision / runner.CONTRACT).read_text())["action"]
    assert (told["name"], told["space"]) == ("grasp", WRIST.to_json())
    found = runner.Decision(decision)(np.asarray(jax.vmap(Lids().reset)(jax.random.split(jax.random.key(1), 5))[1]))
    np.testing.assert_allclose(WRIST.retract(jnp.asarray(found)), found, atol=1e-6)
    capsys.readouterr()
    adapted = ["adapt", run, *NAMED, "--scenario", "loose_mount", "--labels", "20", "--judge-episodes", "20"]
    assert main([*adapted, "--out", str(tmp_path / "new")]) == 0
    assert "wrote" in capsys.readouterr().out
