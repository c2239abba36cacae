"""Time of a Gymnasium environment's step in this package, over the plain vector environment (the faster of two).

    python benchmarks/gymnasium_speed.py --out benchmarks/results/gymnasium_speed.json

Ours is a roll-out inside a compiled program: the policy, `env.step` and the automatic reset, as training has them. The
plain environment is stepped in a loop of Python with the same number of instances and random actions. All ways are
timed in turns within one run, each turn a roll-out of the same number of steps; figures are medians over turns.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import cuelearner_jax as cl
from cuelearner_jax.bridges.gymnasium import source
from cuelearner_jax.devices import CORES
from cuelearner_jax.storage.provenance import provenance

WAYS = {"FetchReach-v4": (0,), "Pendulum-v1": (0, 1), "CartPole-v1": (0, 1)}  # processes of ours; 1: none of its own


def ours(name: str, num_envs: int, steps: int, processes: int) -> Callable[[int], float]:
    """A roll-out of ours: seconds a step of all environments, by the number of the turn."""
    env: Any = cl.from_gymnasium(name, num_envs=num_envs, processes=processes).env

    @jax.jit
    def begin(key: jax.Array) -> Any:
        return jax.vmap(env.reset)(jax.random.split(key, num_envs))

    @jax.jit
    def roll(key: jax.Array, state: Any) -> Any:
        def one(state: Any, number: jax.Array) -> Any:
            k_act, k_step = jax.random.split(jax.random.fold_in(key, number))
            actions = env.actions.sample(k_act, (num_envs,))
            after, step = jax.vmap(env.step)(jax.random.split(k_step, num_envs), state, actions)
            return after, (step.reward, step.obs.sum())

        return jax.lax.scan(one, state, jnp.arange(steps))

    state, _ = begin(jax.random.key(0))
    kept = {"state": jax.block_until_ready(roll(jax.random.key(1), state)[0])}

    def turn(number: int) -> float:
        start = time.perf_counter()
        kept["state"], _ = jax.block_until_ready(roll(jax.random.key(number), kept["state"]))
        return (time.perf_counter() - start) / steps

    return turn


def plain(name: str, num_envs: int, steps: int, mode: str) -> Callable[[int], float]:
    """Return a function that times `gymnasium.vector`."""
    source.registry_spec(name)  # registers gymnasium_robotics, and mends it beside the MuJoCo here
    vector = [lambda: source.make_registered(name, {}, 0)] * num_envs
    kind = gymnasium.vector.SyncVectorEnv if mode == "sync" else gymnasium.vector.AsyncVectorEnv
    env: Any = kind(vector)
    env.reset(seed=0)
    env.action_space.seed(0)

    def turn(number: int) -> float:
        start = time.perf_counter()
        for _ in range(steps):
            env.step(env.action_space.sample())
        return (time.perf_counter() - start) / steps

    turn(0)
    return turn


def measured(name: str, num_envs: int, steps: int, turns: int) -> dict[str, Any]:
    """Median seconds a step of each way, and ours over the faster of the plain ones."""
    ways = {f"plain {mode}": plain(name, num_envs, steps, mode) for mode in ("sync", "async")}
    for processes in WAYS[name]:
        told = "in this process" if processes == 1 else f"in {CORES} processes"
        ways[f"ours {told}"] = ours(name, num_envs, steps, processes)
    times: dict[str, list[float]] = {way: [] for way in ways}
    for number in range(turns):
        for way, turn in ways.items():
            times[way].append(turn(number))
    medians = {way: float(np.median(values)) for way, values in times.items()}
    quartiles = {way: np.quantile(values, [0.25, 0.75]) for way, values in times.items()}
    fastest = min(value for way, value in medians.items() if way.startswith("plain"))
    own = min(value for way, value in medians.items() if way.startswith("ours"))
    return {
        "environment": name,
        "num_envs": num_envs,
        "steps_a_turn": steps,
        "turns": turns,
        "microseconds_a_step": {way: round(1e6 * value, 1) for way, value in medians.items()},
        "quartiles": {way: np.round(1e6 * ends, 1).tolist() for way, ends in quartiles.items()},
        "ratio": round(own / fastest, 3),
        "more_microseconds_a_step": round(1e6 * (own - fastest), 1),
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environments", nargs="*", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--steps", type=int, default=100, help="a turn (default: 100)")
    parser.add_argument("--turns", type=int, default=15, help="of each way (default: 15)")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    asked = parser.parse_args()
    rows = [measured(name, asked.num_envs, asked.steps, asked.turns) for name in asked.environments]
    for row in rows:
        print(json.dumps(row, indent=1), flush=True)
    if asked.out:
        told = {**provenance(), "processors": os.cpu_count(), "rows": rows}
        asked.out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
