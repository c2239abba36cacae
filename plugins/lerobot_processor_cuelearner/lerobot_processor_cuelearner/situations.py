"""Write recorded situations with the actions that a policy proposes, for `cuelearner label`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
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

from lerobot_processor_cuelearner.kinematics import Hand
from lerobot_processor_cuelearner.steps import PlaceStep

LEAST_RANGE = 1e-6  # of an entry that counts as moving
SHARE = 0.05  # of an entry's range, by which the state is shifted to both sides
PLACE = ["x", "y", "z"]  # entries of an action that is a hand's position
MARGIN = 0.1, 0.1  # of the positions' bounds: at least [m], and as a share of their range
BEYOND = 0.1, 0.2  # beyond a joint's limits by this much [rad], most proposals that a right unit leaves there


def write(
    checkpoint: str,
    dataset: Path,
    out: Path,
    count: int,
    seed: int = 0,
    hand_of: Callable[[Sequence[str]], Hand] | None = None,
    matrices: Mapping[str, Path] | None = None,
    effects: bool = True,
    first: int = 0,
) -> int:
    """Write situations at random frames of a dataset, or of the `first` of each episode; return their number.

    A situation holds the state at its frame, and the action that the policy proposes there, in the robot's own units:
    the first action of a new chunk, or a later one of a chunk that was predicted some frames before. `phase` is the
    place in the chunk, from 0 to 1. Pictures show all cameras side by side.

    With `hand_of`, a function of the names of the action's entries, the position that the hand is led to stands for the
    action. With `matrices`, files with a 3x4 projection of a camera, the page shows in pictures where the hand goes.
    With `effects`, the policy is asked twice more an entry of the state, at both sides of it.

    Raises SystemExit, with one line, for a dataset, policy or file that does not fit, or a folder in use.
    """
    if out.exists() and any(out.iterdir()):
        raise SystemExit(f"{out} is not empty: give another --out")
    data = LeRobotDataset(dataset.name, root=dataset)
    names = {key: _names(data, key) for key in (OBS_STATE, ACTION) if key in data.meta.features}
    hand = hand_of(names[ACTION]) if hand_of else None
    projections = _projections(matrices or {}, data)
    policy, config, pre, post = _load(checkpoint, data)
    chunk, steps = int(getattr(config, "n_action_steps", 1)), _steps(data) if effects else None
    frame_index = data.hf_dataset.data.column("frame_index").to_numpy()
    frames = np.random.default_rng(seed).permutation(np.flatnonzero(frame_index < (first or np.inf)))[:count]
    where = np.random.default_rng(seed + 1).uniform(size=len(frames))
    (out / "pictures").mkdir(parents=True)
    rows: list[dict[str, Any]] = []
    for number, (frame, share) in enumerate(zip(frames.tolist(), where, strict=True)):
        now = data[frame]
        before = int(share * min(chunk, int(now["frame_index"]) + 1))
        then = data[frame - before] if before else now
        propose = partial(_proposed, policy, pre, post, then, before, number)
        action, place = propose(torch.zeros(()))
        sides = [propose(way)[0] for way in _both_sides(steps)] if steps is not None else []
        picture = f"pictures/{number:06d}.jpg"
        cameras = [now[key] for key in data.meta.camera_keys]
        if cameras:
            _side_by_side(cameras).save(out / picture, quality=92)
        rows.append(
            {"state": now[OBS_STATE].reshape(-1).numpy(), "action": action, "phase": place / max(chunk - 1, 1)}
            | {"sides": sides, "text": str(now.get("task", "")), "picture": picture if cameras else ""}
        )
    pq.write_table(_table(rows, data, names, hand, projections, steps), out / "situations.parquet")
    return len(rows)


def check_robot(data: LeRobotDataset, checkpoint: str | Path, shapes: Mapping[str, Sequence[int]]) -> None:
    """Raise SystemExit where a dataset's state or action has another shape than the checkpoint's features."""
    for key in (OBS_STATE, ACTION):
        own, shape = data.meta.features.get(key), shapes.get(key)
        if own is not None and shape is not None and tuple(own["shape"]) != tuple(shape):
            raise SystemExit(
                f"{key} has shape {tuple(own['shape'])} in {data.root}, but {tuple(shape)} in {checkpoint}: "
                "give a dataset of the policy's robot"
            )


def _load(checkpoint: str, data: LeRobotDataset) -> tuple[Any, Any, Any, Any]:
    """Return the policy, its configuration and its processors. Raises SystemExit where they do not fit the dataset."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = Path(checkpoint)
    if config.device != "cpu" and not torch.cuda.is_available():
        config.device = "cpu"
    features = {**(config.input_features or {}), **(config.output_features or {})}
    check_robot(data, checkpoint, {key: feature.shape for key, feature in features.items()})
    if OBS_STATE not in data.meta.features:
        raise SystemExit(f"{data.root} has no {OBS_STATE}, on which a correction depends: give a dataset with it")
    policy = make_policy(config, ds_meta=data.meta).eval()
    overrides = {"device_processor": {"device": str(config.device)}}
    pre, post = make_pre_post_processors(config, pretrained_path=checkpoint, preprocessor_overrides=overrides)
    if any(isinstance(step, RelativeActionsProcessorStep) and step.enabled for step in pre.steps):
        raise SystemExit(f"{checkpoint} has relative actions: give a policy of absolute actions")
    if any(isinstance(step, PlaceStep) for step in post.steps):
        raise SystemExit(f"{checkpoint} holds a correction already: give the checkpoint that it was made from")
    return policy, config, pre, post


@torch.no_grad()
def _proposed(
    policy: Any, pre: Any, post: Any, item: dict[str, Any], before: int, seed: int, shift: torch.Tensor
) -> tuple[np.ndarray, int]:
    """Return the action after `before` others of a chunk that is predicted at a frame, and its place in the chunk.

    `shift` is added to the state. A policy that draws its actions draws them from `seed`.
    """
    policy.reset()
    torch.manual_seed(seed)
    place, action = PlaceStep("situations"), None
    for _ in range(before + 1):
        batch = {key: value[None] for key, value in item.items() if key.startswith("observation.")}
        batch[OBS_STATE] = batch[OBS_STATE] + shift
        action = policy.select_action(pre({**batch, "task": [str(item.get("task", ""))]}))
        place({TransitionKey.ACTION: action})  # pyright: ignore[reportArgumentType]
    return post(action).reshape(-1).to("cpu", torch.float32).numpy(), place.place


def _steps(data: LeRobotDataset) -> np.ndarray:
    """Return the step of each entry of the state, by which effects are measured; 0 for one that does not move."""
    stats = (data.meta.stats or {}).get(OBS_STATE, {})
    low, high = (np.asarray(stats.get(name, 0.0), np.float64).reshape(-1) for name in ("min", "max"))
    steps = np.where(high - low < LEAST_RANGE, 0.0, SHARE * (high - low))
    return np.broadcast_to(steps, data.meta.features[OBS_STATE]["shape"])


def _both_sides(steps: np.ndarray) -> Iterator[torch.Tensor]:
    """Return the shifts of the state to both sides of each entry that moves."""
    for entry in np.flatnonzero(steps):
        way = torch.zeros(len(steps))
        way[entry] = float(steps[entry])
        yield from (-way, way)


def _effects(sides: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the change of an action by one unit of each entry (n, entries * action); sides: (n, 2 moving, action)."""
    effects = np.zeros((len(sides), len(steps), sides.shape[-1]), np.float32)
    effects[:, steps > 0] = (sides[:, 1::2] - sides[:, ::2]) / (2 * steps[steps > 0, None])
    return effects.reshape(len(sides), -1)


def _side_by_side(cameras: list[torch.Tensor]) -> Image.Image:
    """Return pictures (3, height, width) of 0 to 1 beside each other, as high as the highest."""
    images = [(camera.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy() for camera in cameras]
    sheet = Image.new("RGB", (sum(image.shape[1] for image in images), max(image.shape[0] for image in images)))
    left = 0
    for image in images:
        sheet.paste(Image.fromarray(image), (left, 0))
        left += image.shape[1]
    return sheet


def _table(
    rows: list[dict[str, Any]],
    data: LeRobotDataset,
    names: dict[str, list[str]],
    hand: Hand | None,
    projections: Sequence[tuple[Any, Any]],
    steps: np.ndarray | None,
) -> pa.Table:
    """Return the table of situations; its metadata has the bounds of the actions, the hand and the projections."""
    states, actions = (np.stack([row[name] for row in rows]) for name in ("state", "action"))
    stats, own = (data.meta.stats or {}).get(ACTION, {}), names[ACTION]
    hands = _hands(states, names, hand) if projections else None
    sides = np.stack([row["sides"] for row in rows]) if steps is not None and steps.any() else None
    if sides is not None and hand is not None:
        sides = hand.place(sides.reshape(-1, actions.shape[1])).reshape(*sides.shape[:2], 3)
    if hand is not None:
        _check_unit(hand, actions)
        actions, stats, own = hand.place(actions).astype(np.float32), {}, PLACE
    columns: dict[str, Any] = {}
    for name, entries, values in (("observation", names[OBS_STATE], states), ("action", own, actions)):
        if len(set(entries)) == values.shape[1] == len(entries):
            columns |= {f"{name}.{entry}": values[:, place] for place, entry in enumerate(entries)}
        else:
            columns[name] = list(values)
    columns |= {name: [row[name] for row in rows] for name in ("phase", "text")}
    if any(row["picture"] for row in rows):
        columns["picture"] = [row["picture"] for row in rows]
    if hands is not None:
        columns["hand"] = list(hands)
    if sides is not None and steps is not None:
        columns["effect"] = list(_effects(sides, steps))
    low = np.minimum(np.asarray(stats.get("min", actions.min(0)), np.float64).reshape(-1), actions.min(0))
    high = np.maximum(np.asarray(stats.get("max", actions.max(0)), np.float64).reshape(-1), actions.max(0))
    margin = 0.0 if hand is None else np.maximum(MARGIN[0], MARGIN[1] * (high - low))
    low, high = low - margin, high + margin
    still = high - low < LEAST_RANGE
    low, high = np.where(still, low - 0.5, low), np.where(still, high + 0.5, high)
    # the next 32-bit numbers, so that rounding leaves no action outside
    ends = np.nextafter(low.astype(np.float32), -np.inf), np.nextafter(high.astype(np.float32), np.inf)
    about: dict[str, Any] = {name: end.tolist() for name, end in zip(("low", "high"), ends, strict=True)}
    if hand is not None:
        arrays = {name: array.round(9).tolist() for name, array in hand.arrays.items()}
        about["hand"] = {"entries": names[ACTION], **arrays}
    about |= {"projections": [one for one, _ in projections], "areas": [area for _, area in projections]}
    return pa.table(columns).replace_schema_metadata({"cuelearner": json.dumps(about)})


def _check_unit(hand: Hand, actions: np.ndarray) -> None:
    """Raise SystemExit where many proposed actions lie far beyond the joints' limits."""
    joints = actions @ hand.joints
    beyond = ((joints < hand.low - BEYOND[0]) | (joints > hand.high + BEYOND[0])).any(1).mean()
    if beyond > BEYOND[1]:
        raise SystemExit(
            f"{100 * beyond:.0f}% of the proposed actions lie beyond the limits of the MJCF's joints: give "
            "--joint-unit degrees or radians as the robot has, and --joints in the order of the action's entries"
        )


def _hands(states: np.ndarray, names: dict[str, list[str]], hand: Hand | None) -> np.ndarray:
    """Return where the hand is in states (n, 3). Raises SystemExit where the state does not tell."""
    own, entries = names[OBS_STATE], names[ACTION] if hand is not None else names[ACTION][:3]
    moves = [True] * len(entries) if hand is None else (hand.joints != 0).any(1)
    values = np.zeros((len(states), len(entries)))
    for place, (name, is_moved) in enumerate(zip(entries, moves, strict=True)):
        if is_moved and name not in own:
            raise SystemExit(f"--projection needs the place of the hand, but {OBS_STATE} has no {name}")
        if is_moved:
            values[:, place] = states[:, own.index(name)]
    return (values if hand is None else hand.place(values)).astype(np.float32)


def _projections(matrices: Mapping[str, Path], data: LeRobotDataset) -> list[tuple[Any, Any]]:
    """Return projections into the picture of all cameras, and the area of each camera, in shares of that picture.

    Raises SystemExit for an unknown camera or a file without a matrix.
    """
    sizes = {key: data[0][key].shape[1:] for key in data.meta.camera_keys} if matrices else {}
    width, height = sum(size[1] for size in sizes.values()), max((size[0] for size in sizes.values()), default=0)
    projections = []
    for camera, path in matrices.items():
        keys = [key for key in sizes if camera in (key, key.rpartition(".")[2])]
        if not keys:
            raise SystemExit(f"the dataset has no camera {camera}: give --projection one of {', '.join(sizes)}")
        left = sum(size[1] for size in list(sizes.values())[: list(sizes).index(keys[0])])
        try:
            matrix = np.asarray(json.loads(path.read_text()), np.float64).reshape(3, 4)
        except (OSError, ValueError, TypeError) as error:
            raise SystemExit(f"{path} holds no 3x4 matrix of numbers: write three rows of four as JSON") from error
        into = np.array([[1 / width, 0, left / width], [0, 1 / height, 0], [0, 0, 1]])
        area = [left / width, 0.0, sizes[keys[0]][1] / width, sizes[keys[0]][0] / height]
        projections.append(((into @ matrix).tolist(), area))
    return projections


def _names(data: LeRobotDataset, key: str) -> list[str]:
    """Return the names of a feature's entries; empty where it has none."""
    return _flat(data.meta.features[key].get("names"))


def _flat(names: Any) -> list[str]:
    """Return the names in nested lists and groups, in the order of the entries."""
    if isinstance(names, dict) and all(type(position) is int for position in names.values()):
        return sorted(names, key=lambda name: names[name])
    if isinstance(names, dict | list | tuple):
        return [name for group in (names.values() if isinstance(names, dict) else names) for name in _flat(group)]
    return [] if names is None else [str(names)]
