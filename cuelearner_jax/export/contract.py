"""Write an exported decision's folder.

contract.json    inputs and outputs with units; versions; digests of the other files and of the contract itself
decision.*       the decision
golden.npz       observations (cases, obs), the last ones extreme, and JAX's actions for them (cases, action)
decide.py        runs the decision: `runner`, with `operations` in place of their import
"""

from __future__ import annotations

import hashlib
import inspect
import io
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cuelearner_jax.environment import Quantity, action_of, actions_of
from cuelearner_jax.errors import UserError, suggestion
from cuelearner_jax.export import operations, runner
from cuelearner_jax.export.decisions import TOLERANCE, golden_cases
from cuelearner_jax.export.formats import FORMATS, trace_policy
from cuelearner_jax.policies import Policy, describe
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.storage.whole import is_used, place_of, replacing

BASE = (
    "a correction alone: the last slice of the observation is the action of a base that is elsewhere, given beside the "
    "other slices, as decide(observation, base_action)"
)
ANGLE = "atan2(action[1], action[0]) [rad]: 0 along x, positive counterclockwise (from x to y)"


def check_request(format: str, out: Path) -> None:
    """Raise UserError unless a decision in that format can be written to a folder."""
    if format not in FORMATS:
        raise UserError(f"unknown format {format!r}{suggestion(format, FORMATS)}")
    _check_free(out)


def _check_free(out: Path) -> None:
    if is_used(out):
        raise UserError(f"{out} is not empty: give another --out")


def write(
    policy: Policy,
    env: Any,
    drawn: Callable[[], Float[np.ndarray, "n obs"]],
    format: str,
    out: Path,
    source: dict[str, Any],
) -> dict[str, Any]:
    """Write a policy's decision and replay its golden cases; the folder appears completely or not at all.

    `drawn` returns observations of the environment, from which golden cases are chosen. `source` is copied to the
    contract.

    Returns the contract, with "difference": the largest difference among the golden cases in this replay. Raises
    UserError for an unknown format, a folder in use, or a policy that cannot be exported.
    """
    check_request(format, out)
    with place_of(out, _check_free) as place:
        policy = jax.tree.map(jnp.asarray, jax.device_get(policy))  # a trained policy may lie on several devices
        base = getattr(env, "base_size", 0)  # only for a correction alone
        sizes = env.obs_size, actions_of(env).size, base
        traced = trace_policy(policy, env.obs_size)
        artefact = FORMATS[format].make(policy, traced, *sizes)
        golden, cases = golden_cases(policy, drawn(), traced=traced), io.BytesIO()
        np.savez(cases, obs=golden.obs, actions=golden.actions)
        files = {artefact.file: artefact.contents, runner.GOLDEN: cases.getvalue(), "decide.py": decide_source()}
        contract = {
            "version": runner.VERSION,
            "artefact": {"format": format, "file": artefact.file, **artefact.about},
            "observation": {"size": env.obs_size, "dtype": "float32", "slices": _slices(env.observation)},
            "action": _action(env, describe(policy)),
            **({"base": {"size": base, "about": BASE}} if base else {}),
            "batch": "observations (n, size), any n; every row is decided by itself",
            "policy": describe(policy),
            "source": source,
            "golden": {"cases": len(golden.obs), "tolerance": TOLERANCE}
            | {"drawn": golden.drawn, "steady": golden.steady, "extreme": golden.extreme},
            "files": {name: hashlib.sha256(contents).hexdigest() for name, contents in files.items()},
            **provenance(),
        }
        contract = json.loads(json.dumps(contract))
        sealed = json.dumps({**contract, runner.DIGEST: runner.digest(contract)}, indent=1) + "\n"
        with place.writing() as folder:
            for name, contents in {**files, runner.CONTRACT: sealed.encode()}.items():
                with replacing(folder / name, "wb") as file:
                    file.write(contents)
            return {**contract, "difference": replay_golden_cases(folder)}


def _action(env: Any, policy: dict[str, Any]) -> dict[str, Any]:
    """Describe an action: its space with cues and units, and the guide's largest change."""
    action, space, radius = action_of(env), actions_of(env), policy.get("clip_radius_deg")
    told = {"name": action.name, "size": space.size, "unit": action.unit, "about": action.about, "dtype": "float32"}
    told["space"] = space.to_json()
    if space == DIRECTIONS:
        return {**told, "angle": ANGLE, "clip_radius_deg": radius}
    return {**told, "clip_radius": radius, "clip_radius_unit": space.unit}


def decide_source() -> bytes:
    """Return `runner` with the contents of `operations` in place of their import: one file that needs only NumPy."""
    own, other = (inspect.getsource(module) for module in (runner, operations))
    imported = "from cuelearner_jax.export.operations import ContractError, compile_ops\n"
    return own.replace(imported, other.partition("from __future__ import annotations\n\n")[2]).encode()


def _slices(observation: Sequence[Quantity]) -> list[dict[str, Any]]:
    ends = list(itertools.accumulate(quantity.size for quantity in observation))
    return [
        {"name": q.name, "from": end - q.size, "to": end, "size": q.size, "unit": q.unit, "about": q.about}
        for q, end in zip(observation, ends, strict=True)
    ]


def replay_golden_cases(folder: Path) -> float:
    """Replay a folder's golden cases; return the largest difference.

    Raises UserError for a folder that is damaged, cannot be run here, or gives other actions.
    """
    try:
        return runner.Decision(folder).check()
    except runner.ContractError as error:
        raise UserError(str(error)) from error


def unlisted_files(folder: Path) -> list[str]:
    """Return the names of files in a folder that its contract does not list. Raises UserError if it is damaged."""
    try:
        return runner.Decision(folder).unlisted
    except runner.ContractError as error:
        raise UserError(str(error)) from error
