"""The examples of logs: an arm's situations and its correction; a node that runs it beside a base."""

import numpy as np
import pytest
from PIL import Image

import cuelearner_jax as cl
from cuelearner_jax.storage import situations
from examples import logs_of_an_arm, ros2_correction

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder that one round of the example leaves, and its errors."""
    folder = tmp_path_factory.mktemp("arm")
    return folder, logs_of_an_arm.main(folder, situations=120, rounds=(0.15,))


def test_the_arm_comes_nearer_and_its_situations_can_be_labelled(made):
    folder, (before, after) = made
    assert before == pytest.approx(3.3, abs=0.2)  # cm: a mean of 6, 3 and 0.8
    assert after < before  # by the labels of one round, all at once
    found = situations.read(folder / "situations")
    assert found.entries == logs_of_an_arm.NAMES
    assert found.observations.shape == (120, 3)
    with Image.open(folder / "situations/pictures/0.png") as picture:
        assert picture.size == (logs_of_an_arm.PIXELS, logs_of_an_arm.PIXELS)
    assert np.isfinite(cl.load_policy(folder / "policy", base=logs_of_an_arm.arm)(found.observations)).all()


@pytest.mark.long
def test_the_arm_is_a_quarter_as_wrong_after_all_rounds(tmp_path):
    before, after = logs_of_an_arm.main(tmp_path)
    assert after < 0.25 * before


def test_the_node_corrects_what_the_base_says_and_passes_it_on_in_doubt(made):
    beside = ros2_correction.Beside(made[0] / "correction")
    obs = np.array([0.1, -0.05, 0.03], np.float32)
    base = logs_of_an_arm.arm(obs[None])[0]
    np.testing.assert_allclose(beside.action(base, 1.0), base, rtol=1e-6)
    assert beside.trouble == "no fresh observation"
    np.testing.assert_array_equal(beside.hear(obs, 1.0), np.concatenate(beside.decide.base_observations(obs)))
    found = beside.action(base, 1.1)
    assert beside.trouble == ""
    np.testing.assert_allclose(found, beside.decide(obs, base))
    assert np.abs(found - base).max() > 1e-3
    np.testing.assert_allclose(beside.action(base, 1.3), base, rtol=1e-6)  # what was seen is stale
    beside.hear(np.array([np.nan, 0.0, 0.0]), 2.0)
    np.testing.assert_allclose(beside.action(base, 2.0), base, rtol=1e-6)
    assert "not finite" in beside.trouble
    for given in (lambda: beside.hear([0.0], 3.0), lambda: beside.action([0.0], 3.0)):
        with pytest.raises(ValueError, match="the contract says 3"):
            given()
