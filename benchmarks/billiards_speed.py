"""Shots a second on the regulation table: `cuelearner_envs.billiards` against Chipmunk (pymunk) at its usual step.

    python benchmarks/billiards_speed.py --shots 4096 --out speed.json

All contenders play the same scenes, half of them racked and half scattered, in random directions. Rounds are
interleaved, so that other work on the machine meets all alike; figures are medians over rounds, compile time apart.
"""

import argparse
import json
import os
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from _measuring import timed
from pymunk_table import USUAL_STEP, PymunkTable, scenes

from cuelearner_envs.billiards import Table, simulate, simulate_many
from cuelearner_envs.billiards.table import rack


def mixed_scenes(table: Table, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Half racked with jitter, half scattered: positions (count, balls, 2) [m] and directions (count,) [rad]."""
    places, angles = scenes(table, count, seed)
    jitter = float(table.rack_jitter) * np.random.default_rng(seed + 1).uniform(-0.5, 0.5, places.shape)
    places[::2] = (np.asarray(rack(table)) + jitter)[::2]
    return places, angles


def main() -> None:
    """Race the contenders and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=int, default=4096, help="side by side in JAX")
    parser.add_argument("--pymunk-shots", type=int, default=512, help="of them played in Chipmunk a round")
    parser.add_argument("--rounds", type=int, default=7, help="interleaved rounds")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    arguments = parser.parse_args()

    table, few = Table.regulation(), min(arguments.pymunk_shots, arguments.shots)
    places, angles = mixed_scenes(table, arguments.shots, seed=0)
    scene = jnp.asarray(places, jnp.float32), jnp.zeros(places.shape[:2], bool), jnp.asarray(angles, jnp.float32)
    tilted = table.replace(acceleration=(0.0, 0.005))
    together, blocks = jax.jit(jax.vmap(simulate, (None, 0, 0, 0))), jax.jit(simulate_many)
    worlds = {threads: PymunkTable(table, USUAL_STEP, threads) for threads in (0, 2)}

    def chipmunk(threads: int) -> None:
        for place, angle in zip(places[:few], angles[:few], strict=True):
            worlds[threads].play(place, angle)

    contenders: dict[str, tuple[int, Callable[[], object]]] = {
        "pymunk, no threads": (few, lambda: chipmunk(0)),
        "pymunk, 2 threads": (few, lambda: chipmunk(2)),
        "vmap(simulate)": (len(angles), lambda: together(table, *scene)),
        "simulate_many": (len(angles), lambda: blocks(table, *scene)),
        "simulate_many, tilted": (len(angles), lambda: blocks(tilted, *scene)),
    }
    first = {name: timed(play)[0] for name, (_, play) in contenders.items()}
    times = {name: [] for name in contenders}
    for _ in range(arguments.rounds):
        for name, (_, play) in contenders.items():
            times[name].append(timed(play)[0])

    rate = {name: shots / float(np.median(times[name])) for name, (shots, _) in contenders.items()}
    peer = max(rate["pymunk, no threads"], rate["pymunk, 2 threads"])
    shot, device = blocks(table, *scene), jax.devices()[0].device_kind
    print(
        f"{os.cpu_count()} cores, JAX on {device}; {float(shot.events.mean()):.1f} events a shot, "
        f"{int(shot.events.max())} at most, {int(shot.exhausted.sum())} exhausted"
    )
    print(f"{'':24}{'shots/s':>10}{'times faster pymunk':>21}{'first call [s]':>16}")
    for name, value in rate.items():
        print(f"{name:24}{value:10,.0f}{value / peer:21.1f}{first[name]:16.1f}")
    if arguments.out:
        times_pymunk = {name: value / peer for name, value in rate.items()}
        figures = {"shots_per_s": rate, "times_pymunk": times_pymunk, "first_call_s": first}
        arguments.out.write_text(json.dumps({"device": device, "cores": os.cpu_count(), **figures}, indent=2))


if __name__ == "__main__":
    main()
