"""Pictures of a camera that has moved, shown to the policy as the camera gave them before.

The move is found from the first pictures of episodes before and after it. Nobody has to answer anything.

Source of the alignment: Evangelidis, Psarakis, "Parametric image alignment using enhanced correlation coefficient
maximization", PAMI 2008, by OpenCV.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep
from torch import Tensor

PRE, NORMALIZER = "policy_preprocessor.json", "normalizer_processor"
STEP = f"{__name__}.PictureStep"
EPISODES = 50  # of which the first pictures are compared, at most
LIKE = 0.7  # correlation from which two pictures show the same place
MOVED = 0.005  # least move of a corner, as a share of the picture, that is one
STILL = 0.04  # spread of a pixel among first pictures from which something moves there
# From coarse to fine: what may change, and the width of the blur as a share of the picture
STAGES = ((cv2.MOTION_TRANSLATION, 0.2), (cv2.MOTION_EUCLIDEAN, 0.06))
UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-7)


@dataclass
class PictureStep(ProcessorStep):
    """Show the policy the pictures of each camera as it gave them before it moved."""

    places: dict[str, list[list[float]]]  # camera -> (2, 3): from a place before to the place now, both from -1 to 1

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with other pictures. Raises ValueError where a camera is missing."""
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        if absent := self.places.keys() - observation.keys():
            raise ValueError(f"{min(absent)} is missing: use the checkpoint of the robot with this camera")
        back = {key: moved_back(observation[key], torch.tensor(one)) for key, one in self.places.items()}
        following = {**transition, TransitionKey.OBSERVATION: {**observation, **back}}
        return following  # pyright: ignore[reportReturnType]

    def get_config(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {"places": self.places}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Return the features as they are."""
        return features


def moved_back(pictures: Tensor, places: Tensor) -> Tensor:
    """Return pictures (..., channels, height, width) in which a place shows what is where `places` (2, 3) leads.

    What was not in the picture repeats its edge.
    """
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    matrix = places.to(flat).expand(len(flat), -1, -1)
    grid = torch.nn.functional.affine_grid(matrix, list(flat.shape), align_corners=False)
    shown = torch.nn.functional.grid_sample(flat, grid, padding_mode="border", align_corners=False)
    return shown.reshape(pictures.shape)


def align(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return where places before are after (2, 3), and the correlation of the pictures as they are and moved back.

    `before`, `after`: pictures (n, height, width, channels) of 0 to 1. Only what is still in all pictures counts. The
    picture may be shifted and turned. Where no move makes it more alike, it has not moved.
    """
    height, width = before.shape[1:3]
    first, second = (np.median(one.mean(-1), 0).astype(np.float32) for one in (before, after))
    still = cv2.erode(255 * (after.mean(-1).std(0) < STILL).astype(np.uint8), np.ones((3, 3), np.uint8))
    own, likeness = np.eye(2, 3, dtype=np.float32), float(cv2.computeECC(first, second, still))
    try:
        for motion, blur in STAGES:
            size = max(3, round(blur * width) | 1)
            likely, own = cv2.findTransformECC(first, second, own, motion, UNTIL, still, size)
    except cv2.error:  # it did not converge
        likely = -1.0
    if likely <= likeness:
        return np.eye(2, 3), likeness, likeness
    even = np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])
    return (even @ np.vstack([own, [0, 0, 1]]) @ np.linalg.inv(even))[:2], likeness, likely


def first_pictures(data: LeRobotDataset, camera: str) -> np.ndarray:
    """Return the first pictures of episodes (n, height, width, channels), from 0 to 1."""
    starts = np.flatnonzero(data.hf_dataset.data.column("frame_index").to_numpy() == 0)[:EPISODES]
    return np.stack([data[int(start)][camera].permute(1, 2, 0).numpy() for start in starts])


def write(checkpoint: Path, before: Path, after: Path, out: Path) -> list[str]:
    """Write a copy of a checkpoint that sees pictures as before its cameras moved; return a line a camera.

    `before`, `after`: folders of LeRobot datasets whose episodes begin alike, from before and after the move.

    Raises SystemExit, with one line, where no camera moved, pictures cannot be aligned, or a folder is in use.
    """
    if out.exists():
        raise SystemExit(f"{out} is there already: give another --out")
    for file in (checkpoint / PRE, before / "meta/info.json", after / "meta/info.json"):
        if not file.exists():
            raise SystemExit(f"{file} is missing: give folders of a LeRobot checkpoint and of datasets, format v3.0")
    config, pre = (json.loads((checkpoint / name).read_text()) for name in ("config.json", PRE))
    if any(step.get("class") == STEP for step in pre["steps"]):
        raise SystemExit(f"{checkpoint} moves its pictures already: give the checkpoint that it was made from")
    features = {**config["input_features"], **config["output_features"]}
    first, second = (LeRobotDataset(one.name, root=one) for one in (before, after))
    for data in (first, second):
        _check_robot(data, features)
    places, lines = {}, []
    for camera in (key for key, one in features.items() if one["type"] == "VISUAL"):
        pictures = [first_pictures(data, camera) for data in (first, second)]
        if pictures[0].shape[1:] != pictures[1].shape[1:]:
            raise SystemExit(f"{camera} has pictures of other sizes in {before} and {after}: give one camera's")
        own, likeness, likely = align(*pictures)
        if likely < LIKE:
            raise SystemExit(
                f"{camera}: {before} and {after} begin with unlike pictures ({likely:.2f}), not moved ones"
            )
        right, down, turn, most = move_of(own)
        if most < MOVED:
            lines.append(f"{camera}: has not moved")
            continue
        places[camera] = own.round(7).tolist()
        lines.append(
            f"{camera}: the picture moved by {abs(right):.1%} to the {'right' if right > 0 else 'left'} and "
            f"{abs(down):.1%} {'down' if down > 0 else 'up'}, and turned by {turn:.1f} degrees clockwise; alike "
            f"{likeness:.2f} as it is, {likely:.2f} moved back"
        )
    if not places:
        raise SystemExit(f"no camera moved between {before} and {after}")
    number = [step.get("registry_name") for step in pre["steps"]].index(NORMALIZER)
    pre["steps"].insert(number, {"class": STEP, "config": {"places": places}})
    part = out.with_name(f"{out.name}.part")  # so that the checkpoint appears whole
    shutil.copytree(checkpoint, part, dirs_exist_ok=True)
    (part / PRE).write_text(json.dumps(pre, indent=2) + "\n", encoding="utf-8")
    part.rename(out)
    return [*lines, f"wrote {out}; next: lerobot-eval --policy.path={out}"]


def _check_robot(data: LeRobotDataset, features: dict[str, Any]) -> None:
    """Raise SystemExit for a dataset of another robot than has a checkpoint's features."""
    for key, one in features.items():
        if key not in data.meta.features:
            raise SystemExit(f"{data.root} has no {key}: give a dataset of the policy's robot")
        if one["type"] != "VISUAL" and (shape := list(data.meta.features[key]["shape"])) != list(one["shape"]):
            raise SystemExit(f"{key} has shape {shape} in {data.root}, {one['shape']} in the policy: give its robot's")


def move_of(places: np.ndarray) -> tuple[float, float, float, float]:
    """Return how far the middle moved right and down, the turn [deg], and how far a corner moved at most, as shares."""
    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    moves = (corners @ (places[:, :2] - np.eye(2)).T + places[:, 2]) / 2
    turn = np.rad2deg(
        np.sign(places[1, 0]) * np.arccos(np.clip(places[0, 0], -1, 1))
    )  # of a picture that is not square
    return float(places[0, 2] / 2), float(places[1, 2] / 2), float(turn), float(np.abs(moves).max())
