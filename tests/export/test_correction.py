"""The correction alone: it does beside a base what the corrected policy does, in every format, without that base."""

import dataclasses
import inspect
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cuelearner_jax as cl
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.export.runner import ContractError
from cuelearner_jax.policies import policy_of
from cuelearner_jax.reading.policy import unread

EPS = 0.05
SIZES = GuideSizes(frame="action", feedback_layers=(8,), fit_steps=40, fit_batch_size=20)
SCALARS = dataclasses.replace(Scalars(), eps_deg=EPS, tau_deg=0.002, tau_max_deg=1.0, feedback_learning_rate=0.02)
OBS, OTHERS = np.split(np.float32([1, 1, 300]) * np.random.default_rng(0).uniform(-1, 1, (67, 3)).astype("f"), [60])


def base(obs):
    """A policy in NumPy, which no file can hold."""
    return np.stack([0.05 * obs[:, 0], np.tanh(obs[:, 1])], -1)


ROBOT = f"""
import sys
sys.path.insert(0, ".")
import numpy as np
from decide import Decision
{inspect.getsource(base)}
decide, obs = Decision("."), np.load("obs.npy")
np.savez("done.npz", difference=decide.check(), actions=decide(obs, *map(base, decide.base_observations(obs))))
assert not {{"jax", "cuelearner_jax"}} & set(sys.modules)
"""


@pytest.fixture(scope="module")
def better():
    """Corrected by labels that ask for more of the first entry, less of the second."""
    how = {"low": (-0.1, -1.0), "high": (0.1, 1.0), "eps": EPS, "bound": 0.2, "sizes": SIZES, "scalars": SCALARS}
    labels = cl.Labels(OBS, base(OBS), np.tile(np.float32([1, -1]), (60, 1)))
    return cl.correct(base, labels, cues="left,right;open,close", guidance="relative", **how)


def test_of_a_saved_policy_it_needs_no_base_and_does_beside_it_what_the_policy_does(better, tmp_path):
    better.save(tmp_path / "better")
    written = cl.export_correction(cl.load_policy(tmp_path / "better", base=base), tmp_path / "out")
    assert written["difference"] <= written["golden"]["tolerance"]
    assert (written["base"]["size"], "questions" in written["base"]) == (2, False)
    assert [cue["words"] for cue in written["action"]["space"]["cues"]] == [["left", "right"], ["open", "close"]]
    assert (written["action"]["clip_radius"], written["action"]["clip_radius_unit"]) == (pytest.approx(0.2), "shares")
    assert [written["artefact"][name] for name in ("input", "base_input", "output")] == ["obs", "base_action", "action"]
    assert [part["name"] for part in written["observation"]["slices"]] == ["observation", "base action"]
    decide = cl.load_exported(tmp_path / "out")
    actions = decide(OTHERS, *map(base, decide.base_observations(OTHERS)))
    np.testing.assert_allclose(actions, better(OTHERS), atol=1e-5)
    assert np.abs(actions - base(OTHERS)).max() > 0.01
    np.testing.assert_allclose(decide(OTHERS[0], base(OTHERS)[0]), actions[0], atol=1e-6)
    for given, told in (
        ((OTHERS,), "give the base's action about each of decide.base_observations"),
        ((OTHERS, base(OTHERS)[:3]), "or equally many"),
        ((OTHERS[:, :2], base(OTHERS)), "or equally many"),
        ((OTHERS, np.full((7, 2), np.nan)), "not finite"),
    ):
        with pytest.raises(ContractError, match=told):
            decide(*given)
    with pytest.raises(ContractError, match="or equally many"):  # before the base is asked
        decide.base_observations(OTHERS[:, :2])


def reading(better, below, theta=0.0, alpha=0.01, bound=0.2):
    """A policy corrected by a shift of what its base sees, a shift and gains of the action, and a process."""
    policy = unread(policy_of(below, better.actions), better.actions, (), 3, labels=6)
    own = policy.correction
    change = own.change.replace(theta=own.change.theta + theta, action=own.change.action + 0.1)
    own = own.replace(change=change, alpha=own.alpha + alpha, scale=jnp.float32(0.1))
    return policy.replace(correction=own, bound=jnp.float32(bound))


def test_a_whole_policy_takes_no_base_action_and_code_can_be_in_no_file(better, tmp_path):
    own = jax.jit(lambda obs: jnp.stack([0.05 * obs[:, 0], jnp.tanh(obs[:, 1])], -1))
    read = dataclasses.replace(better, policy=reading(better, own))
    cl.export_policy(read, tmp_path / "numpy", format="numpy")
    decide = cl.load_exported(tmp_path / "numpy")
    np.testing.assert_allclose(decide(OTHERS, *map(own, decide.base_observations(OTHERS))), read(OTHERS), atol=1e-5)
    with pytest.raises(ContractError, match="holds a whole policy: leave out"):
        decide(OTHERS, base(OTHERS))
    with pytest.raises(cl.UserError, match="or export the correction alone"):
        cl.export_policy(better, tmp_path / "whole")
    with pytest.raises(cl.UserError, match="has no correction"):
        cl.export_correction(cl.CallablePolicy(better.policy.base), tmp_path / "no", world=better.world)


# With a bound or a process, the base is also asked about what is met; a bound of 1 bounds nothing.
@pytest.mark.parametrize(
    ("format", "shifts", "questions"),
    [
        ("numpy", [(0.3, 0.0, 1.0)], 1),
        ("onnx", [(0.1, 0.0, 1.0), (0.2, 0.01, 1.0)], 2),
        ("stablehlo", [(0.1, 0.0, 0.02), (0.2, 0.0, 0.02)], 4),
    ],
)
def test_a_base_elsewhere_is_asked_about_what_it_would_have_seen(format, shifts, questions, better, tmp_path):
    policy = base
    for shift in shifts:
        policy = reading(better, policy, *shift)
    nested = dataclasses.replace(better, policy=policy)
    contract = cl.export_correction(nested, tmp_path / "out", format=format)
    assert (contract["base"]["questions"], contract["golden"]["steady"] > 64) == (questions, True)
    decide = cl.load_exported(tmp_path / "out")
    base_obs = decide.base_observations(OTHERS)
    np.testing.assert_allclose(base_obs[-1], OTHERS - 0.3, atol=1e-4)
    np.testing.assert_allclose(decide(OTHERS, *map(base, base_obs)), nested(OTHERS), atol=1e-5)
    assert np.abs(decide(OTHERS, *[base(OTHERS)] * questions) - nested(OTHERS)).max() > 1e-3
    if format != "stablehlo":
        np.save(tmp_path / "out/obs.npy", OTHERS)
        subprocess.run([sys.executable, "-I", "-c", ROBOT], check=True, cwd=tmp_path / "out")
        with np.load(tmp_path / "out/done.npz") as done:
            np.testing.assert_allclose(done["actions"], nested(OTHERS), atol=1e-5)
