"""Film of the demonstration: a start with a moved camera, by a policy as it was and with its pictures moved back.

    python experiments/lerobot_film.py --task window-open-v3 --folder runs/lerobot_metaworld --out film.gif

Takes what `lerobot_metaworld.py collect` and `train` left in the folder, and the first start at which the two differ.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from _metaworld_pictures import CAMERA, CHANGES, STEPS, ChangedMetaworld, motion
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot_metaworld import EXECUTED, LABEL_SEED, REPORT_SEED, checkpoint, planner
from lerobot_processor_cuelearner.camera import align, first_pictures
from PIL import Image, ImageDraw

SIDE, EVERY, HOLD, COMPARED = 200, 4, 10, 12  # pixels; steps a frame; frames at the end; first pictures compared


def episode(world: ChangedMetaworld, change: str, seed: int, plan: Any, renderer: Any) -> Iterator[np.ndarray]:
    """Yield frames until the first success, or all of an episode without one."""
    obs, chunk, done = world.start(change, seed), np.zeros((0, 4)), False
    for step in range(STEPS):
        if step % EXECUTED == 0:
            chunk = np.clip(plan(world.render()[None], obs[None, :4].astype(np.float32))[0], -1, 1)
        if step % EVERY == 0 or done:
            renderer.update_scene(world._env.data, camera=CAMERA)
            yield np.flip(renderer.render(), (0, 1)).copy()
        if done:
            return
        obs, _, _, _, info = world._env.step(motion(world.change, chunk[step % EXECUTED]))
        done = bool(info["success"])


def captioned(frame: np.ndarray, words: str) -> np.ndarray:
    """Return a frame with words above it."""
    sheet = Image.new("RGB", (SIDE, SIDE + 22), "white")
    sheet.paste(Image.fromarray(frame), (0, 22))
    ImageDraw.Draw(sheet).text((8, 5), words, "black")
    return np.asarray(sheet)


def main() -> None:
    """Write the film."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", required=True)
    parser.add_argument("--folder", type=Path, required=True, help="of lerobot_metaworld.py")
    parser.add_argument(
        "--change", choices=[name for name in CHANGES if "camera" in name], default="camera 10 cm aside"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("lerobot_camera.gif"))
    options = parser.parse_args()
    folder = options.folder / options.task
    act, data = checkpoint(folder / "act"), LeRobotDataset("local/metaworld", root=folder / "dataset")
    size = json.loads((act / "config.json").read_text())["input_features"]["observation.image"]["shape"][-1]
    world = ChangedMetaworld(options.task, size)
    met = []
    for seed in range(LABEL_SEED, LABEL_SEED + COMPARED):
        world.start(options.change, seed)
        met.append(world.render() / 255)
    places = align(first_pictures(data, "observation.image"), np.stack(met))[0].astype(np.float32)
    plans = {"as it was": planner(act, options.device), "pictures moved back": planner(act, options.device, places)}
    renderer, whole = mujoco.Renderer(world._env.model, SIDE, SIDE), -(-STEPS // EVERY)
    for seed in range(REPORT_SEED, REPORT_SEED + 50):
        films = {name: list(episode(world, options.change, seed, plan, renderer)) for name, plan in plans.items()}
        ends = [len(film) for film in films.values()]
        if ends[0] == whole > ends[1]:
            break
    shown = [
        np.concatenate(
            [
                captioned(film[min(number, len(film) - 1)], name + (": done" if number >= len(film) < whole else ""))
                for name, film in films.items()
            ],
            1,
        )
        for number in range(max(ends[1] + HOLD, 3 * HOLD))
    ]
    images = [Image.fromarray(frame).quantize(64, dither=Image.Dither.NONE) for frame in shown]
    images[0].save(options.out, save_all=True, append_images=images[1:], duration=100, loop=0, optimize=True)
    print(f"{options.out}: {options.task}, {options.change}, start {seed}, {len(shown)} frames")


if __name__ == "__main__":
    main()
