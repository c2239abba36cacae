"""Whether the quick argmax (a rough first look, then closely near its peaks) chooses what a full one would.

    python benchmarks/search_agreement.py runs/billiards-paper --out agreement.json

For the agents of a run, on observations that they meet themselves, against all directions in full float32: how often
the choice is the same or close, how much value it gives up as a share of the values' spread, and the reward a step of
agents that choose one way or the other on the same validation episodes. "all, as computed by default" is the full
search at the device's own float32, which on a GPU rounds the factors of its products to 10 bits.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cuelearner_jax import actions as geometry
from cuelearner_jax.actions import DIRECTIONS
from cuelearner_jax.agent.choice import greedy_actions, values
from cuelearner_jax.config import Sizes
from cuelearner_jax.evaluate import episodes, rollout
from cuelearner_jax.guidance import registry as guidance
from cuelearner_jax.policies import Agent
from cuelearner_jax.records.provenance import provenance
from cuelearner_jax.runs import grid as runs
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.kept import restore_policies
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.tasks import registry

STATES = 256  # of an agent
NAMES = ("same", "neighbouring", "within_half_a_degree", "value_given_up", "reward")


def met(env: Any, sizes: Sizes, params: Any) -> jax.Array:
    """Observations (STATES, obs) that an agent meets after a few steps of its own play."""
    state, obs = jax.vmap(env.reset)(jax.random.split(episodes("tuning"), STATES))

    def step(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        state, obs = carry
        after, made = jax.vmap(env.step)(
            jax.random.split(key, STATES), state, greedy_actions(sizes, DIRECTIONS, env, params, obs)
        )
        return (after, made.obs), None

    return jax.lax.scan(step, (state, obs), jax.random.split(jax.random.key(1), 5))[0][1]


def compare(env: Any, agents: Any, own: Sizes, way: Sizes, steps: int, precise: bool) -> dict[str, float]:
    """Means over agents (leading axis of `agents`) of one way to search against the full one."""
    options = geometry.evenly_spaced(way.directions)
    q = values(way, env)

    def one(params: Any) -> dict[str, jax.Array]:
        obs = met(env, own, params)
        with jax.default_matmul_precision("highest"):
            found = jax.lax.map(lambda seen: q(params, seen, options)[:, 0], obs, batch_size=16)
        with jax.default_matmul_precision("highest" if precise else "default"):
            chosen = greedy_actions(way, DIRECTIONS, env, params, obs)
            reward = rollout(Agent(params, way), env, episodes(), 100, steps)["reward"]
        best, number = found.max(-1), found.argmax(-1)
        off = jnp.abs(geometry.difference(options[number], chosen))
        tenth = jnp.deg2rad(360.0 / way.directions)
        taken = jnp.round(geometry.to_angle(chosen) / tenth).astype(int) % way.directions
        lost = (best - found[jnp.arange(STATES), taken]) / (best - found.mean(-1))
        return {
            "same": jnp.mean(off < 0.5 * tenth),
            "neighbouring": jnp.mean(off < 1.5 * tenth),
            "within_half_a_degree": jnp.mean(off < jnp.deg2rad(0.5) + 0.5 * tenth),
            "value_given_up": lost.mean(),
            "reward": reward,
        }

    found = jax.jit(partial(jax.lax.map, one))(agents)
    return {name: float(found[name].mean()) for name in NAMES}


def main() -> None:
    """Compares and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a finished run's folder with its checkpoint")
    parser.add_argument("--coarse", type=int, nargs="+", default=[180, 360, 720])
    parser.add_argument("--peaks", type=int, default=4)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    task, config, grid = runs.load(asked.run, registry.find)
    env = task.environment(config.task, "validation")
    kind = guidance.make(grid.guidance[0], config.sizes, env)
    group = LaneGroup(config, env, kind, Grid((kind.name,), grid.seeds, grid.labels))
    policies, step = restore_policies(group, asked.run / kind.name)
    all_ = dataclasses.replace(config.sizes, coarse_directions=0)
    ways = {"all, in full float32": (all_, True), "all, as computed by default": (all_, False)}
    for coarse in asked.coarse:
        for dtype in ("float32", "bfloat16"):
            sizes = dataclasses.replace(all_, coarse_directions=coarse, coarse_dtype=dtype, peaks=asked.peaks)
            ways[f"{coarse} in {dtype}, {asked.peaks} peaks"] = (sizes, False)
    rows = [
        {"search": name, **compare(env, policies["params"], config.sizes, way, asked.steps, precise)}
        for name, (way, precise) in ways.items()
    ]
    print(f"{'search':32s}  " + "  ".join(f"{name:>20}" for name in NAMES))
    for row in rows:
        print(f"{row['search']:32s}  " + "  ".join(f"{row[name]:>20.5f}" for name in NAMES))
    if asked.out:
        told = {**provenance(), "step": step, "seeds": list(grid.seeds), "rows": rows}
        asked.out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
