"""Play two checkpoints on recorded frames by LeRobot's own functions; print what a correction changes and costs.

Run by the Python that has LeRobot: `python play.py CHECKPOINT CORRECTED DATASET`. Prints one line of JSON.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors

FRAMES, ROUNDS = 12, 300


def load(checkpoint: str, data: LeRobotDataset):
    """Return a policy with its processors."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path, config.device = Path(checkpoint), "cpu"
    pre, post = make_pre_post_processors(config, pretrained_path=checkpoint)
    return make_policy(config, ds_meta=data.meta).eval(), pre, post


def seconds(step, value) -> float:
    """Return the median time of a step."""
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        step(value)
        times.append(time.perf_counter() - start)
    return sorted(times)[ROUNDS // 2]


def apart(correct, proposed, corrected) -> list[list[float]]:
    """Return how far corrected actions are from proposed ones; of a hand, its positions and the last entry."""
    if correct.hand is None:
        return (corrected - proposed).tolist()
    places = [correct.hand.place(actions.numpy()) for actions in (proposed, corrected)]
    return np.column_stack([places[1] - places[0], (corrected - proposed)[:, -1:].numpy()]).tolist()


def main(before: str, after: str, dataset: str) -> None:
    """Play frames in their order, with a reset in the middle of a chunk."""
    data = LeRobotDataset("tiny", root=dataset)
    policy, pre, post = load(before, data)
    policy2, pre2, post2 = load(after, data)
    moves, phases, correct = [], [], post2.steps[2]
    acts = (policy.select_action, pre), (policy2.select_action, pre2)
    for frame in range(FRAMES):
        if frame == FRAMES - 5:
            policy.reset()
            policy2.reset()
        item = data[frame]
        batch = {key: value[None] for key, value in item.items() if key.startswith("observation.")}
        action = policy.select_action(pre({**batch, "task": [item["task"]]}))
        moves += apart(correct, post(action), post2(policy2.select_action(pre2({**batch, "task": [item["task"]]}))))
        phases.append(post2.steps[0].place)
    both = [[own(before({**batch, "task": [""]})) for _ in range(3)] for own, before in acts]
    moved = apart(correct, post(torch.stack(both[0], 1))[0], post2(torch.stack(both[1], 1))[0])
    added = seconds(post2, action) - seconds(post, action) + seconds(pre2.steps[3], {"observation": batch})
    names = [type(step).__name__ for step in (*pre2.steps, *post2.steps)]
    again = Path(after).with_name("saved_again")
    pre2.save_pretrained(again, config_filename="policy_preprocessor.json")
    post2.save_pretrained(again, config_filename="policy_postprocessor.json")
    make_pre_post_processors(PreTrainedConfig.from_pretrained(after), pretrained_path=str(again))
    print(json.dumps({"moves": moves, "chunk": moved, "places": phases, "added_ms": 1e3 * added, "steps": names}))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:])
