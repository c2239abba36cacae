"""File formats of an exported decision, by name."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.errors import UserError
from cuelearner_jax.export import onnx_graph, rules
from cuelearner_jax.export.decisions import CALLBACKS, decision_of, row_by_row
from cuelearner_jax.export.graph import Traced, trace
from cuelearner_jax.policies import Policy

PLATFORMS = ("cpu", "cuda")  # platforms of a decision in StableHLO


class Artefact(NamedTuple):
    """An exported decision as a file."""

    file: str
    contents: bytes
    about: dict[str, Any]  # the contract's entry


class Format(NamedTuple):
    """A file format, with the function that writes it."""

    about: str
    # (policy, its graph, sizes of input, action, and the base's action at the end of the input)
    make: Callable[[Policy, Traced, int, int, int], Artefact]


def _of_graph(traced: Traced, name: str) -> None:
    """Raise UserError if the graph lacks operations of the decision."""
    if traced.missing:
        raise UserError(
            f"--format {name} does not support {', '.join(traced.missing)}, which this policy needs: "
            "give --format stablehlo"
        )


def _numpy(policy: Policy, traced: Traced, obs_size: int, action_size: int, base_size: int) -> Artefact:
    _of_graph(traced, "numpy")
    graph = np.frombuffer(json.dumps(traced.graph.as_json()).encode(), np.uint8)
    stored = io.BytesIO()
    arrays: dict[str, Any] = {"graph": graph, **traced.constants}
    np.savez(stored, **arrays)
    return Artefact("decision.npz", stored.getvalue(), {"needs": "numpy"})


def _onnx(policy: Policy, traced: Traced, obs_size: int, action_size: int, base_size: int) -> Artefact:
    _of_graph(traced, "onnx")
    contents = onnx_graph.serialize(traced, obs_size, action_size, base_size)
    about = {"needs": "onnxruntime", "opset": onnx_graph.OPSET, "input": "obs", "output": "action"}
    about |= {"base_input": onnx_graph.BASE} if base_size else {}
    return Artefact("decision.onnx", contents, about)


def _stablehlo(policy: Policy, traced: Traced, obs_size: int, action_size: int, base_size: int) -> Artefact:
    from jax import export

    decide, (count,) = row_by_row(policy), export.symbolic_shape("n")
    parts = [obs_size - base_size, *([base_size] if base_size else [])]
    shapes = [jax.ShapeDtypeStruct((count, size), jnp.float32) for size in parts]
    together = jax.jit(lambda *seen: decide(jnp.concatenate(seen, -1)))
    exported = export.export(together if base_size else jax.jit(decide), platforms=PLATFORMS)(*shapes)
    about = {"needs": "jax", "jax": jax.__version__, "platforms": list(PLATFORMS)}
    return Artefact("decision.stablehlo", bytes(exported.serialize()), about)


FORMATS = {
    "stablehlo": Format("for JAX: the compiler's own language, for CPUs and NVIDIA GPUs", _stablehlo),
    "onnx": Format("for onnxruntime and what else reads ONNX (extra `onnx`)", _onnx),
    "numpy": Format("for NumPy alone: the parameters, and a file of Python that runs them", _numpy),
}


def trace_policy(policy: Policy, obs_size: int) -> Traced:
    """Trace a policy's decision as a graph.

    Raises UserError for a policy with random actions, or with code other than JAX's.
    """
    assert rules.RULES  # importing `rules` registers them
    found = trace(decision_of(policy), obs_size)
    if CALLBACKS & set(found.missing):
        raise UserError(
            "this policy calls a Python function, which cannot be exported: export a policy of JAX "
            "functions, or the correction alone (--only-correction, cl.export_correction)"
        )
    if found.random:
        raise UserError("this policy acts at random, which cannot be exported: export a deterministic policy")
    return found
