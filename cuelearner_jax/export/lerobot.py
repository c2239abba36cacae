"""Export a correction of proposed actions into a copy of a LeRobot checkpoint, as steps of its processors.

The steps are those of the small package `lerobot_processor_cuelearner`, which needs no JAX. Their state holds the
correction's arrays and golden cases, which are replayed whenever the checkpoint is loaded.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_jax.environment import BASE, EFFECT, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.export.contract import check_unused
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.reading import ReadingPolicy
from cuelearner_jax.reading.families import ACTIONS_ALONE, has_effects
from cuelearner_jax.spaces import Box
from cuelearner_jax.storage.situations import PHASE
from cuelearner_jax.storage.whole import place_of

NAME = "lerobot"
ABOUT = "for LeRobot: the checkpoint of --policy with the correction in its processors"
VERSION = 2  # of the arrays, as the steps read them
STEPS = "lerobot_processor_cuelearner.steps"
STATE_FILE = "policy_postprocessor_cuelearner.safetensors"
PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"
RELATIVE, NORMALIZER, UNNORMALIZER = "relative_actions_processor", "normalizer_processor", "unnormalizer_processor"
CASES = 64
Arrays = dict[str, np.ndarray]


def write(policy: Any, env: Any, names: tuple[str, ...], checkpoint: Path, out: Path, hand: dict[str, Any]) -> Path:
    """Write a checkpoint with the correction of proposed actions, completely or not at all; return its path.

    `env`: the policy's situations. `names`: of the action's entries; empty: not known. `hand`: the robot's kinematics
    where actions are positions of its hand, as `storage.situations`; else empty.

    Raises UserError for a policy without such a correction, a checkpoint of another robot, or of relative actions.
    """
    with place_of(out, check_unused) as place:
        space, arrays = actions_of(env), arrays_of(policy, env)
        size, names = (len(hand["joints"]), tuple(hand["entries"])) if hand else (space.size, names)
        arrays |= {f"hand_{name}": np.asarray(hand[name], np.float32) for name in hand if name != "entries"}
        config, pre, post = (_read(checkpoint / name) for name in ("config.json", PRE, POST))
        state_size = arrays["golden_obs"].shape[1] - 1 - space.size
        _check(checkpoint, config, {"observation.state": state_size, "action": size}, names)
        _check_steps(checkpoint, pre, post)
        digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays.values())).hexdigest()[:16]
        more = {"chunk": int(config.get("n_action_steps") or 1), "version": VERSION}
        shift = {"state_shift": arrays.pop("state_shift").tolist()}
        last = _place(post, UNNORMALIZER) + 1
        pre["steps"].insert(_place(pre, NORMALIZER), _step("StateStep", digest, **shift))
        post["steps"].insert(last, _step("CorrectStep", digest, **more) | {"state_file": STATE_FILE})
        post["steps"].insert(0, _step("PlaceStep", digest))
        with place() as folder:
            shutil.copytree(checkpoint, folder, dirs_exist_ok=True)
            for name, contents in ((PRE, pre), (POST, post)):
                (folder / name).write_text(json.dumps(contents, indent=2) + "\n", encoding="utf-8")
            (folder / STATE_FILE).write_bytes(safetensors(arrays))
        return out


def arrays_of(policy: Any, env: Any) -> Arrays:
    """Return the arrays of a correction and its golden cases, as the steps read them.

    `state_shift` is added to the state that the policy sees, so that golden cases have no effects of the state.

    Raises UserError for a policy that is no correction of proposed actions, or that changes nothing.
    """
    space, slices = actions_of(env), [part for part in env.observation if part.kind != EFFECT]
    sound = isinstance(policy, ReadingPolicy) and isinstance(policy.base, Heuristic)
    sound = sound and (policy.family == ACTIONS_ALONE or has_effects(policy.family))
    if not sound or not isinstance(space, Box) or [part.name for part in slices[-2:]] != [PHASE, BASE]:
        raise UserError(
            "this policy is no correction of proposed actions: label situations that the package "
            "lerobot_processor_cuelearner wrote, and adapt by --labels-from alone"
        )
    own = policy.correction
    situations, alpha = (np.asarray(part) for part in (own.known, own.alpha))
    active = np.abs(alpha).max(-1, initial=0) > 0
    size, theta = sum(part.size for part in slices), np.asarray(own.change.theta)
    if not active.any() and not np.any(np.asarray(own.change.action)) and not theta.any():
        raise UserError("the answers asked for no change that was used, so there is nothing to export: ask for more")
    obs = golden_observations(env)
    own_entries = np.r_[: size - space.size, env.obs_size - space.size : env.obs_size]  # all but the effects
    inputs = np.r_[own_entries, env.obs_size : env.obs_size + space.size]  # and the action again
    act = jax.jit(lambda obs: policy.act(jax.random.key(0), None, obs))
    arrays = {
        "low": space.low,
        "high": space.high,
        "mean": own.frame.mean[own_entries],
        "deviation": jnp.where(own.frame.varies > 0, own.frame.deviation, jnp.inf)[own_entries],
        "known": situations[active][:, inputs],
        "alpha": alpha[active],
        "length": own.length[inputs],
        "beta": own.change.action,
        "scale": own.scale,
        "bound": policy.bound,
        "state_shift": -theta,
        "golden_obs": obs[:, own_entries],
        "golden_action": act(jnp.asarray(obs)),
    }
    return {name: np.asarray(array, np.float32) for name, array in arrays.items()}


def golden_observations(env: Any) -> np.ndarray:
    """Return labelled situations without effects, and as many with other phases and actions (cases, obs)."""
    space, rows = actions_of(env), np.array(env.rows, np.float32)
    end = sum(part.size for part in env.observation if part.kind != EFFECT) - space.size
    rows = rows[:: max(1, len(rows) // (CASES // 2))][: CASES // 2]
    k_phase, k_action = jax.random.split(jax.random.key(0))
    rows[:, end : -space.size] = 0.0
    others = rows.copy()
    others[:, end - 1] = np.asarray(jax.random.uniform(k_phase, (len(rows),)))
    others[:, -space.size :] = np.asarray(space.sample(k_action, (len(rows),)))
    return np.concatenate([rows, others])


def safetensors(arrays: Arrays) -> bytes:
    """Return 32-bit arrays as the contents of a safetensors file."""
    head, end = {}, 0
    for name, array in arrays.items():
        start, end = end, end + array.nbytes
        head[name] = {"dtype": "F32", "shape": list(array.shape), "data_offsets": [start, end]}
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + b"".join(array.tobytes() for array in arrays.values())


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        advice = "give --policy a LeRobot checkpoint, a folder pretrained_model"
        raise UserError(f"{path} cannot be read: {advice}") from error


def _check(checkpoint: Path, config: dict[str, Any], sizes: dict[str, int], names: tuple[str, ...]) -> None:
    """Raise UserError for the checkpoint of another robot."""
    features = {**config.get("input_features", {}), **config.get("output_features", {})}
    for name, size in sizes.items():
        if (shape := features.get(name, {}).get("shape")) != [size]:
            own = f"has {shape[0]} entries" if shape else "is missing"
            advice = "give the checkpoint whose actions were labelled"
            raise UserError(f"{name} {own} in {checkpoint}, and {size} in the correction: {advice}")
    own = tuple(config.get("action_feature_names") or ())
    if own and names and own != names:
        remedy = "give the labelled one"
        raise UserError(f"{checkpoint} moves {', '.join(own)}, the correction {', '.join(names)}: {remedy}")


def _check_steps(checkpoint: Path, pre: dict[str, Any], post: dict[str, Any]) -> None:
    """Raise UserError for processors that a correction cannot join."""
    steps = [*pre["steps"], *post["steps"]]
    if any(step.get("registry_name") == RELATIVE and step.get("config", {}).get("enabled") for step in steps):
        why = "whose chunks a correction would lead astray"
        raise UserError(f"{checkpoint} has relative actions, {why}: give a policy of absolute actions")
    if any(step.get("class", "").startswith(STEPS) for step in steps):
        raise UserError(f"{checkpoint} holds a correction already: give the checkpoint that it was made from")
    for name, of, normaliser in ((PRE, pre, NORMALIZER), (POST, post, UNNORMALIZER)):
        if normaliser not in [step.get("registry_name") for step in of["steps"]]:
            advice = "give another policy"
            raise UserError(f"{checkpoint / name} has no {normaliser}, beside which a correction acts: {advice}")


def _place(pipeline: dict[str, Any], name: str) -> int:
    return [step.get("registry_name") for step in pipeline["steps"]].index(name)


def _step(name: str, pair: str, **more: Any) -> dict[str, Any]:
    return {"class": f"{STEPS}.{name}", "config": {"pair": pair, **more}}
