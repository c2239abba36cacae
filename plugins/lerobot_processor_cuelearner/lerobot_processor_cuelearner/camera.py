"""Find how cameras moved, from the first pictures of episodes before and after, and repair a checkpoint without labels.

Source of the alignment: Evangelidis, Psarakis, "Parametric image alignment using enhanced correlation coefficient
maximization", PAMI 2008, by OpenCV.
"""

from __future__ import annotations

import json
import shutil
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_processor_cuelearner.pictures import PictureStep
from lerobot_processor_cuelearner.situations import check_robot

PRE, NORMALIZER = "policy_preprocessor.json", "normalizer_processor"
STEP = f"{PictureStep.__module__}.{PictureStep.__name__}"
EPISODES = 50  # of which the first pictures are compared, at most
LIKE = 0.7  # correlation from which two pictures show the same place
SAME = 0.97  # the same, of pictures that no move makes more alike
OVERLAP = 0.6  # least share of what is still in a picture that the other one shows too
MOVED = 0.005  # least move of a corner, as a share of the picture, that is one
STILL = 0.04  # spread of a pixel among first pictures from which something moves there
# From coarse to fine: what may change, and the width of the blur as a share of the picture
STAGES = ((cv2.MOTION_TRANSLATION, 0.2), (cv2.MOTION_EUCLIDEAN, 0.06))
UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-7)


def align(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return where places before are after (2, 3), and the correlation of the pictures as they are and moved back.

    `before`, `after`: pictures (n, height, width, channels) of 0 to 1. Only what is still in all pictures counts. The
    picture may be shifted and turned. Where no move makes it more alike, it has not moved if it is alike as it is; else
    the second correlation is -1.
    """
    height, width = before.shape[1:3]
    first, second = (np.median(one.mean(-1), 0).astype(np.float32) for one in (before, after))
    still = cv2.erode(255 * (after.mean(-1).std(0) < STILL).astype(np.uint8), np.ones((3, 3), np.uint8))
    likeness = float(cv2.computeECC(first, second, still))
    likely, best = likeness if likeness > SAME else -1.0, np.eye(2, 3)
    for start, stages in product(_starts(first, second), (STAGES, STAGES[1:])):
        own = start.copy()
        try:
            for motion, blur in stages:
                _, own = cv2.findTransformECC(first, second, own, motion, UNTIL, still, _size(blur, width))
        except cv2.error:  # it did not converge
            continue
        to_first = (own, (width, height))
        overlap = cv2.warpAffine(still, *to_first, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
        if overlap.sum() < OVERLAP * still.sum():
            continue
        back = cv2.warpAffine(second, *to_first, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        if (alike := float(cv2.computeECC(first, back, overlap))) > max(likely, likeness):
            likely, best = alike, own
    even = np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])
    return (even @ np.vstack([best, [0, 0, 1]]) @ np.linalg.inv(even))[:2], likeness, likely


def _starts(first: np.ndarray, second: np.ndarray) -> list[np.ndarray]:
    """Return moves (2, 3) from which to search: none, and the shift by phase correlation, sharp and blurred."""
    height, width = first.shape
    window, shifts = cv2.createHanningWindow((width, height), cv2.CV_32F), [(0.0, 0.0)]
    for blur in (0.0, STAGES[1][1]):
        size = (_size(blur, width),) * 2
        pair = [cv2.GaussianBlur(one, size, 0) if blur else one for one in (first, second)]
        shifts.append(cv2.phaseCorrelate(*(one - one.mean() for one in pair), window)[0])
    return [np.float32([[1, 0, right], [0, 1, down]]) for right, down in shifts]


def _size(blur: float, width: int) -> int:
    """Return the size of a blur's window [pixels], which is odd, from its share of the width [pixels]."""
    return max(3, round(blur * width) | 1)


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
    shapes = {key: one["shape"] for key, one in {**config["input_features"], **config["output_features"]}.items()}
    cameras = [key for key, one in config["input_features"].items() if one["type"] == "VISUAL"]
    first, second = (LeRobotDataset(one.name, root=one) for one in (before, after))
    for data in (first, second):
        check_robot(data, checkpoint, shapes)
        if absent := set(cameras) - data.meta.features.keys():
            raise SystemExit(f"{data.root} has no {min(absent)}: give a dataset of the policy's robot")
    places, lines = {}, []
    for camera in cameras:
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


def move_of(places: np.ndarray) -> tuple[float, float, float, float]:
    """Return how far the middle moved right and down, the turn [deg], and how far a corner moved at most, as shares."""
    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    moves = (corners @ (places[:, :2] - np.eye(2)).T + places[:, 2]) / 2
    cosine = np.clip(places[0, 0], -1, 1)  # the sines differ where a picture is not square
    turn = np.rad2deg(np.sign(places[1, 0]) * np.arccos(cosine))
    return float(places[0, 2] / 2), float(places[1, 2] / 2), float(turn), float(np.abs(moves).max())
