"""Who makes a GPU's matrix products: XLA's own compiled kernels or NVIDIA's library, by lanes at once.

    python benchmarks/matrix_products.py --task billiards --lanes 1 8 16 75 512 --out products.json

Milliseconds of a step of all lanes of the paper's preset, unguided and learning, with one and with the other, in one
run; `devices.LIBRARY_LANES` is chosen by it. Replay is cut to 100,000 steps a seed, which changes memory alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
from pathlib import Path

import jax

from cuelearner_jax import devices, results
from cuelearner_jax.bench import Timed, iterations_of, learning
from cuelearner_jax.tasks import TASKS

WAYS = {"compiled": 2**30, "library": 0}  # from how many lanes on the library is used


def measure(task: str, lanes: int, first_library: int, repeats: int) -> float:
    """Milliseconds of a step of so many lanes."""
    devices.LIBRARY_LANES = first_library
    config = learning(TASKS[task].presets["paper"].config)
    sizes = dataclasses.replace(config.sizes, replay_capacity=100_000, lanes_per_block=lanes)
    config = dataclasses.replace(config, sizes=sizes)
    env = TASKS[task].environment(config.task)
    timed = Timed(config, env, "none", lanes, mesh=devices.lane_mesh(jax.local_devices()[:1]))
    iterations = iterations_of(config, env.obs_size, lanes)
    times = [timed.train(iterations) for _ in range(repeats + 1)]  # the first compiles
    return 1e3 * statistics.median(times[1:]) / (iterations * sizes.num_envs)


def main() -> None:
    """Measures, prints a table, writes JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=sorted(TASKS), default="billiards")
    parser.add_argument("--lanes", type=int, nargs="+", default=[1, 8, 16, 75, 512])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    rows = []
    print(f"{'lanes':>6}  " + "  ".join(f"{way + ' [ms]':>14}" for way in WAYS))
    for lanes in asked.lanes:
        found = {way: measure(asked.task, lanes, first, asked.repeats) for way, first in WAYS.items()}
        rows.append({"task": asked.task, "lanes": lanes, **found})
        print(f"{lanes:>6}  " + "  ".join(f"{value:>14.4f}" for value in found.values()), flush=True)
        if asked.out:
            asked.out.write_text(json.dumps({**results.provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
