"""Write an exported decision's folder.

`contract.json` has inputs and outputs with units, versions, and digests of all files. Beside it are the decision,
`golden.npz` with observations (cases, obs) and JAX's actions for them (cases, action), and `decide.py`, which is
`runner`. Where a correction changes what its base sees, the actions are followed by the base's observations.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cuelearner_jax.environment import action_of, actions_of
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.export import onnx_graph, runner
from cuelearner_jax.export.decisions import TOLERANCE, golden_cases, row_by_row, trace_policy
from cuelearner_jax.export.graph import Traced
from cuelearner_jax.policies import Policy, describe
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.storage.whole import is_occupied, place_of, replacing

ANGLE = "atan2(action[1], action[0]) [rad]: 0 along x, positive counterclockwise (from x to y)"
PLATFORMS = ("cpu", "cuda")  # platforms of a decision in StableHLO
FORMATS = {
    "stablehlo": "for JAX: the compiler's own language, for CPUs and NVIDIA GPUs",
    "onnx": "for onnxruntime and what else reads ONNX (extra `onnx`)",
    "numpy": "for NumPy alone: the parameters, and a file of Python that runs them",
}


def check_request(format: str, out: Path) -> None:
    """Raise UserError unless a decision in that format can be written to a folder."""
    if format not in FORMATS:
        raise UserError(f"unknown format {format!r}{suggestion(format, FORMATS)}")
    check_unused(out)


def check_unused(out: Path) -> None:
    """Raise UserError unless a folder is free to be written."""
    if is_occupied(out):
        raise UserError(f"{out} is not empty: give another --out")


def write(
    policy: Policy,
    env: Any,
    draw: Callable[[], Float[np.ndarray, "n obs"]],
    format: str,
    out: Path,
    source: dict[str, Any],
) -> dict[str, Any]:
    """Write a policy's decision and replay its golden cases; the folder appears completely or not at all.

    `env`: also what `correction_of` returns in its place, with sizes of inputs and outputs and the entry "base".
    `draw` returns observations of it, from which golden cases are chosen. `source` is copied to the contract.

    Returns the contract, with "difference": the largest difference among the golden cases in this replay.
    """
    with place_of(out, check_unused) as place:
        policy = jax.tree.map(jnp.asarray, jax.device_get(policy))  # a trained policy may lie on several devices
        inputs, outputs, base = getattr(env, "alone", ([env.obs_size], [actions_of(env).size], {}))
        traced = trace_policy(policy, env.obs_size)
        file, contents, about = _artefact(format, policy, traced, inputs, outputs)
        golden, cases = golden_cases(policy, draw(), traced, actions_of(env).to_json()), io.BytesIO()
        np.savez(cases, obs=golden.obs, actions=golden.actions)
        files = {file: contents, runner.GOLDEN: cases.getvalue(), "decide.py": inspect.getsource(runner).encode()}
        ends = list(itertools.accumulate(quantity.size for quantity in env.observation))
        slices = [
            {"name": q.name, "from": end - q.size, "to": end, "size": q.size, "unit": q.unit, "about": q.about}
            for q, end in zip(env.observation, ends, strict=True)
        ]
        contract = {
            "version": runner.VERSION,
            "artefact": {"format": format, "file": file, **about},
            "observation": {"size": env.obs_size, "dtype": "float32", "slices": slices},
            "action": _action(env, describe(policy)),
            **({"base": base} if base else {}),
            "batch": "observations (n, size), any n; every row is decided by itself",
            "policy": describe(policy),
            "source": source,
            "golden": {"cases": len(golden.obs), "tolerance": TOLERANCE}
            | {"drawn": golden.candidates, "steady": golden.steady, "extreme": golden.extreme},
            "files": {name: hashlib.sha256(contents).hexdigest() for name, contents in files.items()},
            **provenance(),
        }
        contract = json.loads(json.dumps(contract))
        sealed = json.dumps({**contract, runner.DIGEST: runner.digest(contract)}, indent=1) + "\n"
        with place() as folder:
            for name, contents in {**files, runner.CONTRACT: sealed.encode()}.items():
                with replacing(folder / name, "wb") as stream:
                    stream.write(contents)
            return {**contract, "difference": open_decision(folder)[1]}


def _action(env: Any, policy: dict[str, Any]) -> dict[str, Any]:
    """Describe an action: its space with cues and units, and the guide's largest change."""
    action, space, radius = action_of(env), actions_of(env), policy.get("clip_radius_deg")
    entry = {"name": action.name, "size": space.size, "unit": action.unit, "about": action.about, "dtype": "float32"}
    entry["space"] = space.to_json()
    if space == DIRECTIONS:
        return {**entry, "angle": ANGLE, "clip_radius_deg": radius}
    return {**entry, "clip_radius": radius, "clip_radius_unit": space.unit}


def _artefact(
    format: str, policy: Policy, traced: Traced, inputs: list[int], outputs: list[int]
) -> tuple[str, bytes, dict[str, Any]]:
    """Return a decision's file, its contents, and the contract's entry, for these sizes of its inputs and outputs."""
    if format == "stablehlo":
        decide, (count,) = row_by_row(policy), jax.export.symbolic_shape("n")
        shapes = [jax.ShapeDtypeStruct((count, size), jnp.float32) for size in inputs]
        together = jax.jit(lambda *parts: decide(jnp.concatenate(parts, -1)))
        exported = jax.export.export(together, platforms=PLATFORMS)(*shapes)
        about = {"needs": "jax", "jax": jax.__version__, "platforms": list(PLATFORMS)}
        return "decision.stablehlo", bytes(exported.serialize()), about
    if traced.missing:
        missing = f"{', '.join(traced.missing)}, which this policy needs"
        raise UserError(f"--format {format} does not support {missing}: give --format stablehlo")
    if format == "onnx":
        about = {"needs": "onnxruntime", "opset": onnx_graph.OPSET}
        about |= dict(zip(("input", "base_input"), onnx_graph.INPUTS[: len(inputs)], strict=False))
        about |= dict(zip(("output", "base_output"), onnx_graph.OUTPUTS[: len(outputs)], strict=False))
        return "decision.onnx", onnx_graph.serialize(traced, inputs, outputs), about
    graph, stored = np.frombuffer(json.dumps(traced.graph._asdict()).encode(), np.uint8), io.BytesIO()
    arrays: dict[str, Any] = {"graph": graph, **traced.constants}
    np.savez(stored, **arrays)
    return "decision.npz", stored.getvalue(), {"needs": "numpy"}


def open_decision(folder: Path) -> tuple[runner.Decision, float]:
    """Return a folder's decision, and the largest difference of its golden cases, which were replayed."""
    try:
        decide = runner.Decision(folder)
        return decide, decide.check()
    except runner.ContractError as error:
        raise UserError(str(error)) from error
