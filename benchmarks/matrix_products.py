"""Compare a GPU's matrix products by XLA's own compiled kernels and by NVIDIA's library, by number of lanes.

    python benchmarks/matrix_products.py --task billiards --lanes 1 8 16 75 512 --out products.json

Milliseconds of a step of all lanes of the paper's preset, unguided and learning, with one and with the other, in one
run; `devices.LIBRARY_LANES` was chosen by it. Replay is cut to 100,000 steps a seed, which changes memory alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import jax
from _measuring import measure_training
from scaling import REPLAY

from cuelearner_jax import devices
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry

WAYS = {"compiled": 2**30, "library": 0}  # from how many lanes on the library is used


def main() -> None:
    """Measures, prints a table, writes JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=sorted(registry.names()), default="billiards")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--lanes", type=int, nargs="+", default=[1, 8, 16, 75, 512])
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    task = registry.find(asked.task)
    config = task.presets[asked.preset].config
    config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, replay_capacity=REPLAY))
    mesh, rows = devices.lane_mesh(jax.local_devices()[:1]), []
    print(f"{'lanes':>6}  " + "  ".join(f"{way + ' [ms]':>14}" for way in WAYS))
    for lanes in asked.lanes:
        found = {}
        for way, devices.LIBRARY_LANES in WAYS.items():
            found[way] = measure_training(config, lambda: task.environment(config.task), lanes, asked.seconds, mesh)[
                "ms_a_step"
            ]
        rows.append({"task": asked.task, "lanes": lanes, **found})
        print(f"{lanes:>6}  " + "  ".join(f"{value:>14.4f}" for value in found.values()), flush=True)
        if asked.out:
            asked.out.write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
