"""Scripted arms in changed worlds: the scripts, what is changed and undone, and what the page tells."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest

from cuelearner_envs.fetch.scripts import GOAL, GRIPPER, OBJECT, push, reach

ROOT = Path(__file__).parents[2]


def observed(**places):
    obs = np.zeros((1, 31), np.float32)
    for name, place in places.items():
        obs[0, {"goal": GOAL, "gripper": GRIPPER, "thing": OBJECT}[name]] = place
    return jnp.asarray(obs)


def test_the_scripts_do_what_they_say():
    np.testing.assert_allclose(reach(observed(goal=(1, 0, 0), gripper=(0, 0.01, 0))), [[1, -0.2, 0, 0]], atol=1e-6)
    at = {"goal": (0.3, 0, 0.4), "thing": (0, 0, 0.4)}
    np.testing.assert_array_equal(push(observed(**{**at, "goal": (0.005, 0, 0.4)}, gripper=(-0.1, 0, 0.4))), 0)  # done
    pushes = np.asarray(push(observed(**at, gripper=(-0.06, 0, 0.4))))[0]
    np.testing.assert_allclose(pushes, [0.8, 0, 0, 0], atol=1e-6)  # 8 times 10 cm along the line
    assert np.asarray(push(observed(**at, gripper=(-0.06, 0.01, 0.4))))[0][1] == pytest.approx(-0.14)
    np.testing.assert_allclose(push(observed(**at, gripper=(0.05, 0, 0.4))), [[0, 0, 1, 0]])  # rises before the object


def test_the_page_tells_what_was_recorded():
    pytest.importorskip("gymnasium_robotics")
    import scripted_arms as study

    rows = pq.read_table(ROOT / "docs" / "data" / "scripted_arms.parquet").to_pylist()
    page = (ROOT / "docs" / "results" / "scripted_arms.md").read_text(encoding="utf-8")
    for robots, of in (("Fetch", True), ("Meta-World", False)):
        taught = [row for row in rows if row["labels"] == "labels" and row["robot"].startswith("Fetch") == of]
        for change in dict.fromkeys(row["change"] for row in taught):
            own = [row for row in taught if row["change"] == change]
            ends = [np.mean([row[name] for row in own]) for name in ("unchanged", "before", "after")]
            assert f"| {robots} | {change} | {len(own)} | " + " | ".join(f"{end:.2f}" for end in ends) in page
    tested = [row for row in rows if row["labels"] == study.TESTED]
    assert not any(row["rewarded steps"] for row in rows if row not in tested)
    assert not any(row["before"] - row["after"] > study.WORSE for row in tested)
    shares = [share for row in tested if np.isfinite(share := study.lost(row))]
    sentence = f"the mean over these {len(shares)} cells is {np.mean(shares):.0%}.** Tried were {len(tested)} cells"
    assert sentence in page
    assert f"median is {np.median([row['rewarded steps'] for row in tested]):,.0f} rewarded steps" in page
