"""Training seeds at once: navigation with the paper's networks and a replay of 100,000 steps for each.

    python benchmarks/concurrent_seeds.py --seeds 1 16 1000
    python benchmarks/concurrent_seeds.py --seeds 64 --devices 1 2 4

For each number of seeds (on each device) and of devices: memory of the first device at its peak, time of one gradient
step of all seeds, environment steps a second in all. Unguided lanes; guidance adds its forward passes. With --write it
writes benchmarks/results/concurrent_seeds.json, or device_scaling.json where there are several numbers of devices.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
from pathlib import Path
from typing import Any

import jax
from _measuring import Timed, learning, state_bytes

from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks.navigation import NAVIGATION

RESULTS = Path(__file__).parent / "results"


def measure(config: RunConfig, env: Any, seeds: int, devices: int, iterations: int, repeats: int) -> dict[str, float]:
    """Train `seeds` lanes on so many devices and times stretches of `iterations`."""
    timed = Timed(config, env, "none", seeds, mesh=lane_mesh(jax.local_devices()[:devices]))
    (block,) = timed.blocks
    at_rest, row_bytes = state_bytes(block), block.agent.replay.shape[-1] * 4
    times = [timed.train(iterations) for _ in range(repeats + 1)]  # the first compiles
    stats = jax.devices()[0].memory_stats() or {}
    second = statistics.median(times[1:]) / (iterations * config.sizes.num_envs)
    return {
        "devices": devices,
        "seeds": seeds,
        "ms_per_update": 1e3 * second,
        "steps_per_second": seeds / second,
        "replay_gb": seeds * config.agent.replay_capacity * row_bytes / 1e9,
        "at_rest_gb": at_rest / 1e9,
        "peak_gb": stats.get("peak_bytes_in_use", 0) / 1e9,
    }


def main() -> None:
    """Measures, prints a table, writes JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 16, 1000], help="on each device")
    parser.add_argument("--devices", type=int, nargs="+", default=[1], help="that share the seeds")
    parser.add_argument("--iterations", type=int, default=20, help="iterations of num_envs steps in a timed stretch")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--layers", type=int, nargs="+", help="hidden layers (default: the paper's)")
    parser.add_argument("--write", action="store_true", help="write the JSON file")
    asked = parser.parse_args()
    if max(asked.devices) > jax.local_device_count():
        parser.error(f"--devices: there are {jax.local_device_count()}")
    config = NAVIGATION.presets["paper"].config
    agent = dataclasses.replace(config.agent, q_layers=tuple(asked.layers)) if asked.layers else config.agent
    sizes = dataclasses.replace(config.sizes, lanes_per_block=max(asked.seeds) * max(asked.devices))
    world = dataclasses.replace(config.task, worlds=asked.worlds)
    config = learning(dataclasses.replace(config, task=world, sizes=sizes, agent=agent))
    env = NAVIGATION.environment(config.task)
    rows = [
        measure(config, env, seeds * devices, devices, asked.iterations, asked.repeats)
        for seeds in asked.seeds
        for devices in asked.devices
    ]
    names = list(rows[0])
    print("  ".join(f"{name:>17}" for name in names))
    for row in rows:
        print("  ".join(f"{row[name]:>17,.3f}" for name in names))
    if asked.write:
        name = "device_scaling.json" if len(asked.devices) > 1 else "concurrent_seeds.json"
        (RESULTS / name).write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
