"""Measure how much an answer tells about a turned lidar: walker against teacher, under each assumed turn.

    python experiments/lidar_evidence.py [--situations 1200] [--out FILE]

The shipped walker meets situations with the lidar turned by 15 degrees. Printed for each assumed turn: the median of
the signed and of the absolute difference between what the walker would do behind it and the teacher's direction.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import calibration
import jax
import numpy as np

from cuelearner_jax.calibration.meaning import Meaning
from cuelearner_jax.calibration.walk import Walk
from cuelearner_jax.environment import actions_of
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry

TURNS_DEG = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
WALKER = Path("docs/data/navigation_agent")


def main() -> None:
    """Measures, prints, and writes what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--situations", type=int, default=1_200)
    parser.add_argument("--out", type=Path, help="JSON file")
    asked = parser.parse_args()
    task = registry.find("navigation")
    own, scalars, bases = calibration.bases_of(task, WALKER)
    study = calibration.Study(task, own, scalars, bases, calibration.arguments().parse_args([]), {})
    world, family = study.world("turned_lidar")
    (policy,), space = bases.values(), actions_of(world.env)
    walk = Walk(world.env, world.teacher, world.scalars)
    states, obs = walk.situations(jax.random.key(3), policy, asked.situations)
    turn = tuple(one for one in family if one.name == "lidar: turn")
    meant = Meaning(policy, space).actions(turn, np.array(TURNS_DEG)[:, None], np.asarray(obs))
    best = jax.lax.map(lambda row: world.teacher.best_action(*row), (states, obs), batch_size=16)
    off = np.asarray(space.to_unit(space.log(meant, np.asarray(best)[None])))[..., 0]
    rows = [
        {"turn_deg": turn, "median": float(np.median(row)), "median_apart": float(np.median(np.abs(row)))}
        for turn, row in zip(TURNS_DEG, off, strict=True)
    ]
    for row in rows:
        print("turn {turn_deg:4.0f}: median {median:5.1f}, apart {median_apart:5.1f} degrees".format(**row))
    if asked.out:
        asked.out.write_text(
            json.dumps({**provenance(), "situations": asked.situations, "rows": rows}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
