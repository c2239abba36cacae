"""A folder of plain pictures to label: a gripper, a cup, and the motions of a policy that was wrong by a constant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image, ImageDraw

ENTRIES = ("sideways", "height", "fingers")
CUES = "left,right;up,down;open,close"
HIGH = np.array([0.5, 0.3, 1.0], np.float32)  # of an action; low is minus that
WRONG = np.array([0.15, -0.09, 0.0], np.float32)  # what the policy adds to what would be right
WIDTH, HEIGHT = 640, 480  # pixels


def best(obs: np.ndarray) -> np.ndarray:
    """The right motions (n, 3) for what is seen (n, 4): the gripper over the cup, open while they are apart."""
    cup, gripper = obs[:, :2], obs[:, 2:]
    toward = np.stack([gripper[:, 0] - cup[:, 0], gripper[:, 1] - cup[:, 1] + 0.6], -1) * (0.25, 0.15)
    apart = np.abs(gripper[:, :1] - cup[:, :1])
    return np.clip(np.concatenate([toward, np.where(apart > 0.3, 1.0, -1.0) * 0.8], -1), -HIGH, HIGH).astype(np.float32)


def write(folder: Path, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Write so many situations; return what is seen in them (count, 4), and what the policy did (count, 3)."""
    random = np.random.default_rng(seed)
    (folder / "pictures").mkdir(parents=True)
    obs = random.uniform(-1, 1, (count, 4)).astype(np.float32)
    actions = np.clip(best(obs) + WRONG, -HIGH, HIGH)
    grain = random.integers(0, 14, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    names = [f"pictures/{number:04d}.jpg" for number in range(count)]
    for seen, name in zip(obs, names, strict=True):
        _drawn(seen, grain).save(folder / name, quality=90)
    columns = {f"action.{name}": actions[:, number] for number, name in enumerate(ENTRIES)}
    pq.write_table(pa.table({"observation": list(obs), **columns, "picture": names}), folder / "situations.parquet")
    return obs, actions


def _drawn(obs: np.ndarray, grain: np.ndarray) -> Image.Image:
    image = Image.fromarray(grain + np.array([190, 186, 176], np.uint8))
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0.62 * HEIGHT, WIDTH, HEIGHT), fill=(128, 98, 70))
    x, y = WIDTH * (0.5 + 0.28 * obs[0]), HEIGHT * (0.76 + 0.1 * obs[1])
    draw.rounded_rectangle((x - 28, y - 60, x + 28, y), 8, fill=(190, 60, 45))
    draw.ellipse((x - 28, y - 68, x + 28, y - 50), fill=(120, 30, 25))
    x, y = WIDTH * (0.5 + 0.28 * obs[2]), HEIGHT * (0.34 + 0.1 * obs[3])
    draw.rectangle((x - 9, 0, x + 9, y - 30), fill=(70, 78, 92))
    draw.rectangle((x - 40, y - 38, x + 40, y - 22), fill=(50, 56, 70))
    for side in (-34, 34):
        draw.rectangle((x + side - 6, y - 22, x + side + 6, y + 26), fill=(50, 56, 70))
    return image
