"""The study of Fetch with a displaced camera: its pieces, its arithmetic, the scripts, and what was recorded."""

import importlib
import json
import re
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.fetch.scripts import GOAL, GRIPPER, OBJECT, push, reach

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data" / "fetch"


@pytest.fixture(scope="module")
def study():
    pytest.importorskip("gymnasium_robotics")
    sys.path.insert(0, str(ROOT / "experiments"))
    try:
        yield importlib.import_module("fetch_hand_eye")
    finally:
        sys.path.remove(str(ROOT / "experiments"))


def observed(**places):
    obs = np.zeros((1, 31), np.float32)
    for name, place in places.items():
        obs[0, {"goal": GOAL, "gripper": GRIPPER, "thing": OBJECT}[name]] = place
    return jnp.asarray(obs)


def test_the_scripts_do_what_they_say():
    far = reach(observed(goal=(1, 0, 0), gripper=(0, 0.01, 0)))
    np.testing.assert_allclose(far, [[1, -0.2, 0, 0]], atol=1e-6)
    at = {"goal": (0.3, 0, 0.4), "thing": (0, 0, 0.4)}
    np.testing.assert_array_equal(push(observed(**{**at, "goal": (0.005, 0, 0.4)}, gripper=(-0.1, 0, 0.4))), 0)  # done
    pushes = np.asarray(push(observed(**at, gripper=(-0.06, 0, 0.4))))[0]
    np.testing.assert_allclose(pushes, [0.8, 0, 0, 0], atol=1e-6)  # 8 times 10 cm along the line
    assert np.asarray(push(observed(**at, gripper=(-0.06, 0.01, 0.4))))[0][1] == pytest.approx(-0.14)
    np.testing.assert_allclose(push(observed(**at, gripper=(0.05, 0, 0.4))), [[0, 0, 1, 0]])  # rises before the object
    travels = np.asarray(push(observed(**at, gripper=(0.05, 0, 0.485))))[0]
    assert travels[0] == -1
    assert abs(travels[2]) < 1e-5
    down = np.asarray(push(observed(**at, gripper=(-0.07, 0, 0.485))))[0]
    np.testing.assert_allclose(down[:3], [0, 0, -1], atol=1e-5)


def test_pieces_are_named_and_unknown_ones_refused(study, capsys):
    assert study.main(["--list"]) == 0
    told = capsys.readouterr().out.split()
    assert len(told) == 2 * 3 * 4
    assert "FetchPush-v4/reading/3" in told
    assert np.linalg.norm(study.OFFSET) == pytest.approx(0.03)
    with pytest.raises(SystemExit):
        study.main(["--pieces", "FetchSlide-v4/base/0"])


@pytest.mark.long
def test_a_teacher_sees_true_places_and_the_camera_does_not(study, tmp_path):
    """The wrapper against Gymnasium's own observation, and a file that grows at the scale `smoke`."""
    from cuelearner_envs.fetch.hand_eye import onlooker

    for environment in study.SCRIPTS:
        env = study.hand_eye(environment, study.OFFSET)
        leaves = study.leaves_of(environment, env.observation_space)
        seen = study.flatten(leaves, env.reset(seed=3)[0])
        true = study.flatten(leaves, env.env.reset(seed=3)[0])
        moved = np.flatnonzero(np.abs(seen - true) > 1e-6)
        assert moved.tolist() == ([4] if "Reach" in environment else [1, 4, 10, 13])
        np.testing.assert_allclose((seen - true)[moved], 0.03, atol=1e-6)
        best = onlooker(environment, study.OFFSET).best_action(None, jnp.asarray(seen))
        np.testing.assert_allclose(best, study.SCRIPTS[environment](jnp.asarray(true)[None])[0], atol=1e-4)
        env.close()
    out = ["--scale", "smoke", "--split", "tuning", "--out", str(tmp_path), "--pieces", "FetchReach-v4/base/0"]
    assert study.main(out) == 0
    told = json.loads((tmp_path / "FetchReach-v4" / "base" / "0.json").read_text())
    assert [row["success"] for row in told["rows"]] == [[1, 1], [0, 0]]
    assert study.main(out) == 2  # exists
    assert study.main([*out, "--resume"]) == 0


def test_what_the_page_says_was_recorded(study):
    """The rows on the page are the recorded pieces' own, of which no step was rewarded."""
    page = (ROOT / "docs" / "results" / "fetch.md").read_text(encoding="utf-8")
    found = [line.rsplit("  ", 1)[-1].strip() for line in study.table(DATA).splitlines()]
    shown = re.findall(r"\d+\.\d \[\d+\.\d, \d+\.\d\]", page)
    assert len(shown) >= 12
    assert set(shown) <= set(found)
    for file in DATA.glob("*/*/*.json"):
        head = json.loads(file.read_text())
        assert head["split"] == "validation"
        assert all(row.get("rewarded_steps", 0) == 0 for row in head["rows"])
