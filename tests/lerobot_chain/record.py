"""Record a tiny LeRobot dataset in the shapes of PushT: a point walks to a place that the picture shows.

Run by the Python that has LeRobot: `python record.py FOLDER`.
"""

import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

EPISODES, STEPS, SIDE = 4, 25, 96
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "observation.image": {"dtype": "image", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
}


def main(folder: Path) -> None:
    """Record the episodes."""
    random = np.random.default_rng(0)
    data = LeRobotDataset.create("tiny", fps=10, features=FEATURES, root=folder, use_videos=False)
    for _ in range(EPISODES):
        place, goal = random.uniform(100, 400, (2, 2))
        for _ in range(STEPS):
            action = place + 0.3 * (goal - place)
            picture = np.zeros((SIDE, SIDE, 3), np.uint8)
            x, y = (goal / 512 * SIDE).astype(int)
            picture[y - 4 : y + 4, x - 4 : x + 4] = 255
            state, wanted = place.astype(np.float32), action.astype(np.float32)
            data.add_frame({"observation.state": state, "observation.image": picture, "action": wanted, "task": "go"})
            place = action + random.normal(0, 2, 2)
        data.save_episode()
    data.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
