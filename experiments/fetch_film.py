"""Film FetchPush whose camera is displaced by 3 cm: the script as it is, and the script after 100 labels.

    MUJOCO_GL=egl python experiments/fetch_film.py --out runs/fetch_film

The displacement that the labels told is read from docs/data/fetch, where `experiments/fetch_hand_eye.py` recorded it.
Films are OUT/before/push.gif and OUT/after/push.gif. MuJoCo draws without a screen by EGL (MUJOCO_GL=egl) or osmesa.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import fetch_hand_eye
import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_envs.fetch.hand_eye import SEEN, HandEye
from cuelearner_envs.fetch.scripts import SCRIPTS
from cuelearner_jax import pictures
from cuelearner_jax.bridges.gymnasium.layout import flatten, leaves_of
from cuelearner_jax.bridges.gymnasium.source import make_registered
from cuelearner_jax.tasks import fetch_layout

ENVIRONMENT = "FetchPush-v4"
RECORDED = Path(__file__).resolve().parents[1] / "docs" / "data" / "fetch" / ENVIRONMENT / "calibration" / "0.json"
EVERY = 2  # steps of the film's frames
FPS = 12.5
SIZE = 320  # pixels of a frame's sides


def found_shift() -> np.ndarray:
    """Read by how much 100 labels of all cues told that the camera is displaced, x, y and z [m]."""
    row = json.loads(RECORDED.read_text())["rows"][0]
    return np.array([float(re.findall(r"shift .: (\S+)", words)[0]) for words in row["estimates"]])


def script(shift: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the script, which sees what a camera tells less a shift [m]."""
    act = jax.jit(SCRIPTS[ENVIRONMENT])

    def policy(obs: np.ndarray) -> np.ndarray:
        for start in SEEN[ENVIRONMENT]:
            obs[start : start + 3] -= shift
        return np.asarray(act(jnp.asarray(obs, jnp.float32)[None]))[0]

    return policy


def filmed(policy: Callable[[np.ndarray], np.ndarray], seeds: Sequence[int], to: Path) -> list[bool]:
    """Write a film of the episodes of these seeds; return which of them succeed."""
    drawn = {"render_mode": "rgb_array", "default_camera_config": fetch_layout.CAMERA, "width": SIZE, "height": SIZE}
    env = make_registered(ENVIRONMENT, drawn, fetch_hand_eye.STEPS)
    seen = HandEye(env, fetch_hand_eye.OFFSET, fetch_hand_eye.WITHIN[ENVIRONMENT])
    leaves = leaves_of(ENVIRONMENT, seen.observation_space)
    frames: list[Any] = []
    succeeded = []
    for seed in seeds:
        obs, info = seen.reset(seed=seed)[0], {}
        for number in range(fetch_hand_eye.STEPS):
            obs, *_, info = seen.step(policy(np.array(flatten(leaves, obs))))
            if number % EVERY == 0:
                frames.append(env.render())
        succeeded.append(bool(info["is_success"]))
    to.parent.mkdir(parents=True, exist_ok=True)
    pictures.animate(frames, to, FPS)
    return succeeded


def main() -> None:
    """Film both policies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/fetch_film"), help="folder (default: %(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[10_000, 10_008, 10_011], help="of the episodes")
    asked = parser.parse_args()
    for name, shift in (("before", np.zeros(3)), ("after", found_shift())):
        succeeded = filmed(script(shift), asked.seeds, asked.out / name / "push.gif")
        print(f"{name}: camera moved back by {shift.round(4)} m, {sum(succeeded)} of {len(succeeded)} succeed")


if __name__ == "__main__":
    main()
