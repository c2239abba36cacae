"""Exported decisions of calibrated policies: every derived change in the graph, named in the contract with its unit."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_worlds import BOX, Yard, aims, grips, situations

import cuelearner_jax as cl
from cuelearner_jax.calibration import Calibrated, Distortion, Unknown, declared_distortions
from cuelearner_jax.calibration.families import unknowns_of
from cuelearner_jax.export import contract, runner
from cuelearner_jax.policies import Opaque

DRAWN = np.asarray(situations(jax.random.key(3), None, 48)[1])
POLICIES = {"directions": Opaque(aims), "box": Opaque(grips, actions=BOX)}
WORLDS = {"directions": Yard(), "box": Yard(BOX)}


def calibrated(space, family=None):
    """All changes that the world declares, each of them some way from zero."""
    family = declared_distortions(WORLDS[space], gains=True) if family is None else family
    sizes = {"m": 0.05, "degrees": 13.0, "percent": 7.0, "shares": 0.1}
    theta = [sizes[one.unit] * (-1) ** number for number, one in enumerate(unknowns_of(family))]
    return Calibrated(POLICIES[space], jnp.array(theta), family)


@pytest.mark.parametrize("space", WORLDS)
@pytest.mark.parametrize("format", ["numpy", "onnx", "stablehlo"])
def test_an_exported_decision_sees_and_does_what_the_calibrated_policy_does(tmp_path, space, format):
    if format == "onnx":
        pytest.importorskip("onnxruntime")
    policy = calibrated(space)
    told = contract.write(policy, WORLDS[space], lambda: DRAWN, format, tmp_path / "out", {"subject": "test"})
    wanted, before = (np.asarray(one.act(jax.random.key(0), None, jnp.asarray(DRAWN))) for one in (policy, policy.base))
    np.testing.assert_allclose(cl.load_exported(tmp_path / "out")(DRAWN), wanted, atol=1e-5)
    assert np.abs(wanted - before).max() > 0.05
    assert told["policy"]["changes"] == [
        {"name": one.name, "value": pytest.approx(float(value)), "unit": one.unit}
        for one, value in zip(unknowns_of(policy.family), policy.theta, strict=True)
    ]
    assert json.loads((tmp_path / "out" / runner.CONTRACT).read_text())["policy"] == told["policy"]


def test_a_change_of_ones_own_in_plain_python_is_refused_in_one_line(tmp_path):
    def sees(theta, obs):
        shape = jax.ShapeDtypeStruct(obs.shape, obs.dtype)
        return jax.pure_callback(
            lambda rows, by: np.asarray(rows + by[..., :1], np.float32), shape, obs, theta, vmap_method="expand_dims"
        )

    own = calibrated("directions", (Distortion("own", (Unknown("own: size", "m"),), sees),))
    with pytest.raises(cl.UserError, match="calls a Python function, which cannot be exported"):
        contract.write(own, WORLDS["directions"], lambda: DRAWN, "numpy", tmp_path / "out", {})
    rows = lambda theta, obs: obs + theta[0] * jnp.linalg.det(jnp.outer(obs[:4], obs[:4]) + jnp.eye(4))  # noqa: E731
    rare = calibrated("directions", (Distortion("rare", (Unknown("rare: size", "m"),), rows),))
    with pytest.raises(cl.UserError, match="does not support"):
        contract.write(rare, WORLDS["directions"], lambda: DRAWN, "numpy", tmp_path / "out", {})
    assert not (tmp_path / "out").exists()
