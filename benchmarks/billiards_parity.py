"""Agreement of `cuelearner_envs.billiards` with Chipmunk (pymunk) at a fine step, on random scenes of every preset.

    python benchmarks/billiards_parity.py --scenes 300 --out parity.json

Where they disagree on what was pocketed, Chipmunk plays the scene again at a step twenty times finer (1e-5 s),
which tells whose error it was.
Positions are compared where the same balls were pocketed: over all balls left on the table, and over those that moved.
"""

import argparse
import json
import multiprocessing
import time
from pathlib import Path

import jax
import numpy as np
from pymunk_table import FINE_STEP, PymunkTable, scenes

from cuelearner_envs.billiards import Table, simulate_many

FINEST_STEP = 1e-5  # [s]
PRESETS = {"one_ball": Table.one_ball, "easy": Table.easy, "regulation": Table.regulation}


def engine(case: tuple[Table, np.ndarray, np.ndarray, float]) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Chipmunk's outcome of each scene; one process's share."""
    table, places, angles, step = case
    world = PymunkTable(table, step)
    return [world.play(place, angle) for place, angle in zip(places, angles, strict=True)]


def compare(table: Table, count: int, seed: int, pool) -> dict:
    """Return one row of the table: shares and distances over `count` random scenes."""
    places, angles = scenes(table, count, seed)
    shares = np.array_split(np.arange(count), 16)
    played = pool.map(engine, [(table, places[s], angles[s], FINE_STEP) for s in shares], chunksize=1)
    theirs = [shot for share in played for shot in share]
    ours = jax.jit(simulate_many)(table, places.astype("f4"), np.zeros(places.shape[:2], bool), angles.astype("f4"))
    ours = jax.tree.map(np.asarray, ours)
    pocketed = np.array([p for _, p, _ in theirs])
    agree = (pocketed == ours.pocketed).all(1)
    doubtful = np.flatnonzero(~agree)
    again = pool.map(engine, [(table, places[[i]], angles[[i]], FINEST_STEP) for i in doubtful], chunksize=1)
    settled = sum(bool((share[0][1] == ours.pocketed[i]).all()) for share, i in zip(again, doubtful, strict=True))
    distance = np.linalg.norm(np.array([x for x, _, _ in theirs]) - ours.positions, axis=-1)
    distance = distance[agree][~pocketed[agree]] * 1e3
    moved = np.linalg.norm(ours.positions - places, axis=-1)[agree][~pocketed[agree]] > 1e-3
    late = np.abs(np.array([t for _, _, t in theirs]) - ours.duration)[agree]
    return {
        "scenes": count,
        "same_pocketed": float(agree.mean()),
        "same_pocketed_finest": float((agree.sum() + settled) / count),
        "pocketed_a_scene": float(pocketed.sum(1).mean()),
        "median_mm": float(np.median(distance)),
        "median_moved_mm": float(np.median(distance[moved])),
        "p90_moved_mm": float(np.quantile(distance[moved], 0.9)),
        "median_duration_s": float(np.median(late)),
        "exhausted": int(ours.exhausted.sum()),
    }


def main() -> None:
    """Compare everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=300, help="random scenes a preset and setting")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes")
    parser.add_argument("--processes", type=int, default=2, help="that run Chipmunk side by side")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    arguments = parser.parse_args()

    rows = []
    with multiprocessing.get_context("spawn").Pool(arguments.processes) as pool:
        for name, preset in PRESETS.items():
            settings = {
                "friction 0": {"friction": 0.0},
                "friction 0.25": {},
                "tilt 0.005": {"acceleration": (0.0, 0.005)},
            }
            for setting, change in settings.items():
                began = time.perf_counter()
                row = compare(preset().replace(**change), arguments.scenes, arguments.seed, pool)
                rows.append({"table": name, "setting": setting, **row})
                print(f"{name}, {setting}: {time.perf_counter() - began:.0f} s", flush=True)

    print(f"\n{'':26}{'same balls pocketed':^24}{'distance [mm]':^27}")
    print(
        f"{'table':12}{'setting':14}{'step 2e-4':>12}{'step 1e-5':>12}{'all':>9}{'moved':>9}{'90%':>9}{'exhausted':>11}"
    )
    for row in rows:
        print(
            f"{row['table']:12}{row['setting']:14}{row['same_pocketed']:12.1%}{row['same_pocketed_finest']:12.1%}{row['median_mm']:9.2f}"
            f"{row['median_moved_mm']:9.2f}{row['p90_moved_mm']:9.2f}{row['exhausted']:11d}"
        )
    if arguments.out:
        arguments.out.write_text(json.dumps({"step_s": FINE_STEP, "jax": jax.__version__, "rows": rows}, indent=2))


if __name__ == "__main__":
    main()
