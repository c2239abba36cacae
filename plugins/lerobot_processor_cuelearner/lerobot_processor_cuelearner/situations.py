"""Write recorded situations with the actions that a policy proposes, for `cuelearner label`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.lerobot_types import TransitionKey
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.processor import RelativeActionsProcessorStep
from lerobot.utils.constants import ACTION, OBS_STATE
from PIL import Image

from lerobot_processor_cuelearner.steps import PlaceStep

LEAST_RANGE = 1e-6  # of an entry of the action that counts as moving


def write(checkpoint: str, dataset: Path, out: Path, count: int, seed: int = 0) -> int:
    """Write situations at random frames of a dataset; return their number.

    A situation holds the state at its frame, and the action that the policy proposes there, in the robot's own units:
    the first action of a new chunk, or a later one of a chunk that was predicted some frames before. `phase` is the
    place in the chunk, from 0 to 1. Pictures show all cameras side by side.

    Raises SystemExit, with one line, for a dataset or policy that does not fit, or a folder in use.
    """
    if out.exists() and any(out.iterdir()):
        raise SystemExit(f"{out} is not empty: give another --out")
    data = LeRobotDataset(dataset.name, root=dataset)
    policy, config, pre, post = _load(checkpoint, data)
    chunk = int(getattr(config, "n_action_steps", 1))
    frames = np.random.default_rng(seed).permutation(len(data))[:count]
    where = np.random.default_rng(seed + 1).uniform(size=len(frames))
    (out / "pictures").mkdir(parents=True)
    rows: list[dict[str, Any]] = []
    for number, (frame, share) in enumerate(zip(frames.tolist(), where, strict=True)):
        now = data[frame]
        before = int(share * min(chunk, int(now["frame_index"]) + 1))
        action, place = _proposed(policy, pre, post, data[frame - before] if before else now, before)
        picture = f"pictures/{number:06d}.jpg"
        cameras = [now[key] for key in data.meta.camera_keys]
        if cameras:
            _side_by_side(cameras).save(out / picture, quality=92)
        rows.append(
            {"state": now[OBS_STATE].reshape(-1).numpy(), "action": action, "phase": place / max(chunk - 1, 1)}
            | {"text": str(now.get("task", "")), "picture": picture if cameras else ""}
        )
    pq.write_table(_table(rows, data), out / "situations.parquet")
    return len(rows)


def _load(checkpoint: str, data: LeRobotDataset) -> tuple[Any, Any, Any, Any]:
    """Return the policy, its configuration and its processors. Raises SystemExit where they do not fit the dataset."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = Path(checkpoint)
    if config.device != "cpu" and not torch.cuda.is_available():
        config.device = "cpu"
    for key, feature in {**(config.input_features or {}), **(config.output_features or {})}.items():
        own = data.meta.features.get(key)
        if own is not None and key in (OBS_STATE, ACTION) and tuple(own["shape"]) != tuple(feature.shape):
            raise SystemExit(
                f"{key} has shape {tuple(own['shape'])} in {data.root}, but {tuple(feature.shape)} in {checkpoint}: "
                "give a dataset of the policy's robot"
            )
    if OBS_STATE not in data.meta.features:
        raise SystemExit(f"{data.root} has no {OBS_STATE}, on which a correction depends: give a dataset with it")
    policy = make_policy(config, ds_meta=data.meta).eval()
    overrides = {"device_processor": {"device": str(config.device)}}
    pre, post = make_pre_post_processors(config, pretrained_path=checkpoint, preprocessor_overrides=overrides)
    if any(isinstance(step, RelativeActionsProcessorStep) and step.enabled for step in pre.steps):
        raise SystemExit(f"{checkpoint} has relative actions: give a policy of absolute actions")
    return policy, config, pre, post


@torch.no_grad()
def _proposed(policy: Any, pre: Any, post: Any, item: dict[str, Any], before: int) -> tuple[np.ndarray, int]:
    """Return the action after `before` others of a chunk that is predicted at a frame, and its place in the chunk."""
    policy.reset()
    place, action = PlaceStep("situations"), None
    for _ in range(before + 1):
        batch = {key: value[None] for key, value in item.items() if key.startswith("observation.")}
        action = policy.select_action(pre({**batch, "task": [str(item.get("task", ""))]}))
        place({TransitionKey.ACTION: action})  # pyright: ignore[reportArgumentType]
    return post(action).reshape(-1).to("cpu", torch.float32).numpy(), place.place


def _side_by_side(cameras: list[torch.Tensor]) -> Image.Image:
    """Return pictures (3, height, width) of 0 to 1 beside each other, as high as the highest."""
    images = [(camera.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy() for camera in cameras]
    sheet = Image.new("RGB", (sum(image.shape[1] for image in images), max(image.shape[0] for image in images)))
    left = 0
    for image in images:
        sheet.paste(Image.fromarray(image), (left, 0))
        left += image.shape[1]
    return sheet


def _table(rows: list[dict[str, Any]], data: LeRobotDataset) -> pa.Table:
    """Return the table of situations; its metadata has the bounds of the actions and what a checkpoint must have."""
    states, actions = (np.stack([row[name] for row in rows]) for name in ("state", "action"))
    columns: dict[str, Any] = {}
    names: dict[str, list[str]] = {}
    for name, key, values in (("observation", OBS_STATE, states), ("action", ACTION, actions)):
        names[name] = _flat(data.meta.features[key].get("names"))
        if len(set(names[name])) == values.shape[1] == len(names[name]):
            columns |= {f"{name}.{entry}": values[:, place] for place, entry in enumerate(names[name])}
        else:
            columns[name] = list(values)
    columns |= {name: [row[name] for row in rows] for name in ("phase", "text")}
    if any(row["picture"] for row in rows):
        columns["picture"] = [row["picture"] for row in rows]
    stats = (data.meta.stats or {}).get(ACTION, {})
    low = np.minimum(np.asarray(stats.get("min", actions.min(0)), np.float64).reshape(-1), actions.min(0))
    high = np.maximum(np.asarray(stats.get("max", actions.max(0)), np.float64).reshape(-1), actions.max(0))
    still = high - low < LEAST_RANGE
    low, high = np.where(still, low - 0.5, low), np.where(still, high + 0.5, high)
    # the next 32-bit numbers, so that rounding leaves no action outside
    ends = np.nextafter(low.astype(np.float32), -np.inf), np.nextafter(high.astype(np.float32), np.inf)
    bounds = {name: [float(value) for value in end] for name, end in zip(("low", "high"), ends, strict=True)}
    return pa.table(columns).replace_schema_metadata({"cuelearner": json.dumps(bounds)})


def _flat(names: Any) -> list[str]:
    """Return the names in nested lists and groups, in the order of the entries."""
    if isinstance(names, dict) and all(type(position) is int for position in names.values()):
        return sorted(names, key=lambda name: names[name])
    if isinstance(names, dict | list | tuple):
        return [name for group in (names.values() if isinstance(names, dict) else names) for name in _flat(group)]
    return [] if names is None else [str(names)]
