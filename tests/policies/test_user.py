"""Policies of the user's own: code without a hash, and a file that is exported again."""

from dataclasses import dataclass

import jax
import numpy as np
import pytest

from cuelearner_jax.policies import policy_of
from cuelearner_jax.spaces import Box

OBS = np.float32([[0.25, -0.5]])
act = jax.jit(lambda policy, obs: policy.act(jax.random.key(0), None, obs))


@dataclass
class Gain:
    gain: float

    def __call__(self, obs):
        return self.gain * obs


def test_code_without_a_hash_and_a_file_that_is_exported_again_act(tmp_path):
    onnx = pytest.importorskip("onnx").helper
    source, target = (onnx.make_tensor_value_info(name, 1, ["n", 2]) for name in ("obs", "action"))
    for operation, gain in (("Identity", 1.0), ("Neg", -1.0)):
        graph = onnx.make_graph([onnx.make_node(operation, ["obs"], ["action"])], "policy", [source], [target])
        model = onnx.make_model(graph, opset_imports=[onnx.make_opsetid("", 18)], ir_version=8)
        (tmp_path / "policy.onnx").write_bytes(model.SerializeToString())
        for policy in (Gain(gain), tmp_path / "policy.onnx"):
            np.testing.assert_allclose(act(policy_of(policy, Box((-1.0, -1.0), (1.0, 1.0))), OBS), gain * OBS)
