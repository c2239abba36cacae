"""Film FetchPush whose camera is displaced by 3 cm: the script as it is, and the script after 100 labels.

    python experiments/fetch_film.py --out runs/fetch_film

Labels, teacher and settings are those of `experiments/fetch_hand_eye.py`, of which docs/results/fetch.md reports. The
films are OUT/before/push.gif and OUT/after/push.gif; MuJoCo draws without a screen (MUJOCO_GL=egl or osmesa).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import fetch_hand_eye
import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_envs.fetch.hand_eye import HandEye
from cuelearner_envs.fetch.scripts import SCRIPTS
from cuelearner_jax import pictures
from cuelearner_jax.bridges.gymnasium.layout import flatten, leaves_of
from cuelearner_jax.bridges.gymnasium.source import make_registered
from cuelearner_jax.policies import in_space, policy_of
from cuelearner_jax.tasks import fetch_layout

ENVIRONMENT = "FetchPush-v4"
FPS = 25.0  # a step a frame


def filmed(policy: Any, seeds: list[int], to: Path) -> list[bool]:
    """Write a film of the episodes of these seeds; return which of them succeed."""
    drawn = {"render_mode": "rgb_array", "default_camera_config": fetch_layout.CAMERA}
    env = make_registered(ENVIRONMENT, drawn, fetch_hand_eye.STEPS)
    seen = HandEye(env, fetch_hand_eye.OFFSET, fetch_hand_eye.WITHIN[ENVIRONMENT])
    leaves = leaves_of(ENVIRONMENT, seen.observation_space)
    act = jax.jit(lambda obs: policy.act(jax.random.key(0), None, obs))
    frames, succeeded = [], []
    for seed in seeds:
        obs, info = seen.reset(seed=seed)[0], {}
        for _ in range(fetch_hand_eye.STEPS):
            obs, *_, info = seen.step(np.asarray(act(jnp.asarray(flatten(leaves, obs), jnp.float32)[None]))[0])
            frames.append(env.render())
        succeeded.append(bool(info["is_success"]))
    to.parent.mkdir(parents=True, exist_ok=True)
    pictures.animate(frames, to, FPS)
    return succeeded


def main() -> None:
    """Adapt the script, film both policies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/fetch_film"), help="folder (default: %(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[10_000, 10_001, 10_002], help="of the episodes")
    asked = parser.parse_args()
    script = in_space(policy_of(jax.jit(SCRIPTS[ENVIRONMENT])), fetch_hand_eye.world_of(ENVIRONMENT).actions)
    print(f"before: {filmed(script, asked.seeds, asked.out / 'before' / 'push.gif')}", flush=True)
    found = fetch_hand_eye.adapt(ENVIRONMENT, "calibration", fetch_hand_eye.Condition("all"), 100, 0)
    print("\n".join(one.words() for one in found.estimates if one.changed))
    print(f"after: {filmed(found.policy, asked.seeds, asked.out / 'after' / 'push.gif')}")


if __name__ == "__main__":
    main()
