"""Logs of an arm, corrected without a simulator: pictures, answers, a better policy, its correction as a file.

    python examples/logs_of_an_arm.py runs/arm

A camera above a table sees a block; the arm's policy proposes where to put its fingers, and how far to open them. The
camera was moved, so everything is proposed a little too far to the right. The folder gets recorded situations, which
`cuelearner label runs/arm/situations --cues "left,right;up,down;open,close"` would show to a person. Here a function
answers in a person's place, in three rounds: about what is proposed by then, moved at random. Some minutes on 2 cores.
"""

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image, ImageDraw

import cuelearner_jax as cl

CUES = "left,right;up,down;open,close"
NAMES = ("sideways", "forward", "fingers")
LOW, HIGH = np.array([-0.3, -0.3, 0.0]), np.array([0.3, 0.3, 0.08])  # [m]; more of the first is farther to the left
RANGE = HIGH - LOW
EPS = 0.03  # of the ranges: what a person calls a step
PIXELS = 160  # of a picture's sides


def wanted(obs):
    """The right actions (n, 3) for blocks at x, y of a width [m] (n, 3): at the block, a little wider than it."""
    return np.stack([obs[:, 0], obs[:, 1], obs[:, 2] + 0.01], -1)


def arm(obs):
    """The arm's policy since the camera was moved: 6 cm too far to the right, 3 cm too near, fingers too narrow."""
    return np.clip(wanted(obs) + np.array([-0.06, -0.03, -0.008]), LOW, HIGH)


def blocks(count, random):
    """Blocks at x, y of a width [m], (count, 3)."""
    return np.column_stack([random.uniform(-0.2, 0.2, (count, 2)), random.uniform(0.02, 0.05, count)])


def drawn(block, action):
    """A picture from above: the block, and where the fingers would come down."""
    picture = Image.new("RGB", (PIXELS, PIXELS), (214, 206, 192))
    draw = ImageDraw.Draw(picture)
    place = lambda x, y: (PIXELS * (0.5 - x / 0.7), PIXELS * (0.5 - y / 0.7))  # noqa: E731
    (x, y), half = place(*block[:2]), PIXELS * block[2] / 1.4
    draw.rectangle((x - half, y - half, x + half, y + half), fill=(70, 110, 180))
    (x, y), half = place(*action[:2]), PIXELS * action[2] / 1.4
    for side in (-half, half):
        draw.rectangle((x + side - 1.5, y - 6, x + side + 1.5, y + 6), fill=(40, 40, 40))
    return picture


def record(folder, count, random):
    """Write a folder of situations; return their observations."""
    (folder / "pictures").mkdir(parents=True)
    obs = blocks(count, random)
    actions, names = arm(obs), [f"pictures/{number}.png" for number in range(count)]
    for name, block, action in zip(names, obs, actions, strict=True):
        drawn(block, action).save(folder / name)
    entries = {f"action.{name}": actions[:, number] for number, name in enumerate(NAMES)}
    pq.write_table(pa.table({"observation": list(obs), **entries, "picture": names}), folder / "situations.parquet")
    return obs


def answered(policy, obs, reach, random):
    """Labels: what a person would say of a policy's actions, moved at random by up to `reach` of the ranges."""
    actions = np.clip(policy(obs) + random.uniform(-reach, reach, obs.shape) * RANGE, LOW, HIGH)
    apart = (wanted(obs) - actions) / RANGE
    return cl.Labels(obs, actions, np.where(np.abs(apart) <= EPS / 2, 0.0, np.sign(apart)))


def main(folder="runs/arm", situations=200, rounds=(0.2, 0.08, 0.04)):
    """Mean errors [cm] before and after, in situations that nobody answered about."""
    folder, random = Path(folder), np.random.default_rng(0)
    obs = record(folder / "situations", situations, random)
    better, labels = arm, cl.Labels(obs[:0], obs[:0], obs[:0])
    for asked, reach in zip(np.array_split(obs, len(rounds)), rounds, strict=True):
        parts = zip(labels, answered(better, asked, reach, random), strict=True)
        labels = cl.Labels(*map(np.concatenate, parts))
        print(f"a reading of {len(labels.obs)} answers ...")
        better = cl.correct(arm, labels, cues=CUES, low=LOW, high=HIGH, eps=EPS, bound=0.25)
    others = blocks(500, random)
    print(*cl.agreement(better, answered(arm, others[:100], 0.2, random)).words(), sep="\n")
    errors = [100 * float(np.abs(policy(others) - wanted(others)).mean()) for policy in (arm, better)]
    print(f"mean error: {errors[0]:.1f} cm before, {errors[1]:.1f} cm after {situations} labels")
    better.save(folder / "policy")
    cl.export_correction(better, folder / "correction", format="numpy")
    decide = cl.load_exported(folder / "correction")  # on the robot: the decide.py beside it, with NumPy alone
    actions = decide(others, *map(arm, decide.base_observations(others)))
    assert np.allclose(actions, better(others), atol=1e-4)
    return errors


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "runs/arm")
