"""The correction alone: it does beside a base what the corrected policy does, in every format, without that base."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cuelearner_jax as cl
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.export.runner import ContractError
from cuelearner_jax.policies import policy_of
from cuelearner_jax.reading.policy import unread

LOW, HIGH = (-0.1, -1.0), (0.1, 1.0)
EPS = 0.05
SIZES = GuideSizes(frame="action", feedback_layers=(8,), fit_steps=40, fit_batch_size=20)
SCALARS = dataclasses.replace(Scalars(), eps_deg=EPS, tau_deg=0.002, tau_max_deg=1.0, feedback_learning_rate=0.02)
RANDOM = np.random.default_rng(0)
OBS = RANDOM.uniform(-1, 1, (60, 3)).astype(np.float32)
OTHERS = RANDOM.uniform(-1, 1, (7, 3)).astype(np.float32)


def base(obs):
    """A policy in NumPy, which no file can hold."""
    return np.stack([0.05 * obs[:, 0], np.tanh(obs[:, 1])], -1)


def labels(count=60):
    """More of the first entry, less of the second."""
    obs = OBS[:count]
    return cl.Labels(obs, base(obs).astype(np.float32), np.tile(np.array([1.0, -1.0], np.float32), (count, 1)))


@pytest.fixture(scope="module")
def better():
    """Corrected by these."""
    how = {"low": LOW, "high": HIGH, "eps": EPS, "bound": 0.2, "sizes": SIZES, "scalars": SCALARS}
    return cl.correct(base, labels(), cues="left,right;open,close", guidance="relative", **how)


@pytest.mark.parametrize("format", ["onnx", "numpy", "stablehlo"])
def test_beside_its_base_it_does_what_the_policy_does(format, better, tmp_path):
    written = cl.export_correction(better, tmp_path / "out", format=format)
    assert written["difference"] <= written["golden"]["tolerance"]
    assert written["base"]["size"] == 2
    assert [cue["words"] for cue in written["action"]["space"]["cues"]] == [["left", "right"], ["open", "close"]]
    assert (written["action"]["clip_radius"], written["action"]["clip_radius_unit"]) == (pytest.approx(0.2), "shares")
    assert format != "onnx" or (written["artefact"]["input"], written["artefact"]["base_input"]) == (
        "obs",
        "base_action",
    )
    assert [part["name"] for part in written["observation"]["slices"]] == ["observation", "base action"]
    decide = cl.load_exported(tmp_path / "out")
    found = decide(OTHERS, base(OTHERS))
    np.testing.assert_allclose(found, better(OTHERS), atol=1e-5)
    assert np.abs(found - base(OTHERS)).max() > 0.01
    np.testing.assert_allclose(decide(OTHERS[0], base(OTHERS)[0]), found[0], atol=1e-6)


def test_of_a_saved_policy_it_needs_no_base(better, tmp_path):
    better.save(tmp_path / "better")
    again = cl.load_policy(tmp_path / "better", base=base)
    cl.export_correction(again, tmp_path / "out", format="numpy")
    decide = cl.load_exported(tmp_path / "out")
    np.testing.assert_allclose(decide(OTHERS, base(OTHERS)), better(OTHERS), atol=1e-5)
    for given, told in (
        ((OTHERS,), r"give the base's action, decide\(obs, base_action\)"),
        ((OTHERS, base(OTHERS)[:3]), "equally many rows"),
        ((OTHERS[:, :2], base(OTHERS)), "equally many rows"),
        ((OTHERS, np.full((7, 2), np.nan)), "not finite"),
    ):
        with pytest.raises(ContractError, match=told):
            decide(*given)
    with pytest.raises(cl.UserError, match="is not empty"):
        cl.export_correction(better, tmp_path / "out")


def test_a_whole_policy_takes_no_base_action_and_code_can_be_in_no_file(better, tmp_path):
    with pytest.raises(cl.UserError, match="or export the correction alone"):
        cl.export_policy(better, tmp_path / "whole")
    with pytest.raises(cl.UserError, match="has no correction"):
        cl.export_correction(cl.CallablePolicy(better.policy.base), tmp_path / "no", world=better.world)


def test_a_reading_is_exported_whole_and_alone_unless_its_base_sees_something_else(better, tmp_path):
    own = jax.jit(lambda obs: jnp.stack([0.05 * obs[:, 0], jnp.tanh(obs[:, 1])], -1))
    policy = unread(policy_of(own, better.actions), better.actions, (), OBS.shape[1], labels=6)
    correction = policy.correction.replace(
        change=policy.correction.change.replace(action=0.1 * jnp.ones_like(policy.correction.change.action)),
        alpha=0.01 * jnp.ones_like(policy.correction.alpha),
        scale=jnp.float32(0.1),
    )
    policy = policy.replace(bound=jnp.float32(0.2))
    read = dataclasses.replace(better, policy=policy.replace(correction=correction))
    assert np.abs(read(OTHERS) - own(OTHERS)).max() > 0.01
    cl.export_policy(read, tmp_path / "numpy", format="numpy")
    np.testing.assert_allclose(cl.load_exported(tmp_path / "numpy")(OTHERS), read(OTHERS), atol=1e-5)
    with pytest.raises(ContractError, match="holds a whole policy: leave out"):
        cl.load_exported(tmp_path / "numpy")(OTHERS, base(OTHERS))
    aside = correction.replace(change=correction.change.replace(theta=correction.change.theta + 0.1))
    with pytest.raises(cl.UserError, match="asks its base about other observations"):
        cl.export_correction(dataclasses.replace(read, policy=policy.replace(correction=aside)), tmp_path / "out")
