"""Record a tiny LeRobot dataset: a point walks to a place that the picture shows, in the shapes of PushT.

Run by the Python that has LeRobot: `python record.py FOLDER`. With `python record.py FOLDER MJCF`, the joints of an arm
walk to a pose, and the picture shows the hand from above; `camera.json` has the projection. Behind both is a plain
table with a block. With `python record.py FOLDER moved`, the scene is `MOVED` further right and down.
"""

import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot_processor_cuelearner.kinematics import hand_of

EPISODES, STEPS, SIDE = 4, 25, 96
MOVED = (7, 3)  # pixels
JOINTS = [f"{name}.pos" for name in ("pan", "lift", "elbow", "turn", "flex", "roll", "jaw")]
LOW, HIGH = np.array([[-30, 0, 60, -20, 40, -20, 0.0], [30, 30, 80, 20, 80, 20, 0.04]])  # degrees and metres
ABOVE = [[80, 0, 0, 8], [0, -80, 0, 48], [0, 0, 0, 1.0]]  # x to the right, y up in the picture


def features(names):
    """Return the features of a robot whose state and action have these entries."""
    numbers = {"dtype": "float32", "shape": (len(names),), "names": names}
    picture = {"dtype": "image", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]}
    return {"observation.state": numbers, "observation.image": picture, "action": numbers}


def main(folder: Path, what: Path | None = None) -> None:
    """Record the episodes."""
    mjcf, (right, down) = (None, MOVED) if what == Path("moved") else (what, (0, 0))
    random, (y, x) = np.random.default_rng(right), np.mgrid[-down : SIDE - down, -right : SIDE - right]
    table, block = y > 56, (abs(x - 28) < 4) & (abs(y - 72) < 3)
    behind = np.repeat(np.uint8(90 + 60 * table + 70 * block)[..., None], 3, 2)
    names, low, high = (["x", "y"], [100, 100], [400, 400]) if mjcf is None else (JOINTS, LOW, HIGH)
    data = LeRobotDataset.create("tiny", fps=10, features=features(names), root=folder, use_videos=False)
    hand = hand_of(mjcf, "grip", [], "degrees", names) if mjcf else None
    for _ in range(EPISODES):
        place, goal = random.uniform(low, high, (2, len(names)))
        for _ in range(STEPS):
            action = place + 0.3 * (goal - place)
            picture = behind.copy()
            shown = goal / 512 * SIDE if hand is None else np.array(ABOVE) @ np.append(hand.place(place[None])[0], 1)
            x, y = shown[:2].astype(int)
            picture[y - 4 : y + 4, x - 4 : x + 4] = 255
            numbers = {"observation.state": place.astype(np.float32), "action": action.astype(np.float32)}
            data.add_frame({**numbers, "observation.image": picture, "task": "go"})
            place = action + (random.normal(0, 2, 2) if hand is None else random.normal(0, 0.005, 7) * (HIGH - LOW))
        data.save_episode()
    data.finalize()
    if hand is not None:
        folder.with_name("camera.json").write_text(json.dumps(ABOVE))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
