"""Navigation steps a second of the quadruped in MJX, lidar and automatic reset included.

    python benchmarks/anymal_speed.py --robots 4096 16384 --write

One step of navigation is 0.2 s: ten steps of the walking policy, twenty of the physics, 271 beams, collisions and the
reset. `--control-steps 5` measures steps of 0.1 s too. Directions are random; observations are added up, so that none
is optimised away. "no lidar" leaves them out, "control" counts the walking policy's steps alone. Figures are medians
over rounds, compile time apart. Writes benchmarks/results/anymal_speed.json with --write.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cuelearner_envs.anymal import policy
from cuelearner_envs.anymal.environment import LeggedNavigation
from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_envs.navigation.config import make_environment as make_navigation
from cuelearner_jax.spaces import directions
from cuelearner_jax.storage.provenance import provenance

RESULTS = Path(__file__).parent / "results" / "anymal_speed.json"


def environment(folder: Path, control_steps: int, worlds: int) -> LeggedNavigation:
    """Return cluttered halls with the quadruped, which walks by the policy in a folder."""
    plain = make_navigation(NavigationConfig(style="clutter", worlds=worlds))
    return LeggedNavigation(
        worlds=plain.worlds,
        lidar=plain.lidar.replace(noise=jnp.float32(0.02)),
        max_steps=plain.max_steps,
        period=0.02 * control_steps,
        walking=policy.load(folder),
        control_steps=control_steps,
    )


def see_all(done: Any) -> jax.Array:
    """Return a sum that needs the whole observation."""
    return done.obs.sum() + done.reward


def see_reward(done: Any) -> jax.Array:
    """Return the reward alone, so that the lidar is never computed."""
    return done.reward


def rates(env: LeggedNavigation, see: Callable, robots: int, steps: int, rounds: int) -> tuple[list[float], float]:
    """Navigation steps a second of each round, and the seconds that compiling and a first round took."""

    @jax.jit
    def run(env: LeggedNavigation, state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        def one(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            state, total = carry
            k_action, k_step = jax.random.split(key)
            told = directions.uniform(k_action, (robots,))
            state, done = jax.vmap(env.step)(jax.random.split(k_step, robots), state, told)
            return (state, total + jax.vmap(see)(done).sum()), None

        return jax.lax.scan(one, (state, jnp.float32(0)), jax.random.split(key, steps))[0]

    state = jax.jit(lambda env, keys: jax.vmap(env.reset)(keys)[0])(env, jax.random.split(jax.random.key(0), robots))
    began = time.perf_counter()
    state, total = jax.block_until_ready(run(env, state, jax.random.key(1)))
    first, found = time.perf_counter() - began, []
    for number in range(rounds):
        began = time.perf_counter()
        state, total = jax.block_until_ready(run(env, state, jax.random.key(2 + number)))
        found.append(robots * steps / (time.perf_counter() - began))
    if not jnp.isfinite(total):
        raise SystemExit("the observations are not finite: these figures mean nothing")
    return found, first


def main() -> None:
    """Measure and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[16], help="side by side")
    parser.add_argument("--control-steps", type=int, nargs="+", default=[10], help="in a step of navigation")
    parser.add_argument("--steps", type=int, default=5, help="of navigation, in a round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--policy", type=Path, default=policy.SHIPPED, help="folder of the walking policy")
    parser.add_argument("--parts", action="store_true", help="also without the lidar")
    parser.add_argument("--write", type=Path, nargs="?", const=RESULTS, help="file (default: %(const)s)")
    asked = parser.parse_args()
    rows = []
    for control_steps in asked.control_steps:
        env = environment(asked.policy, control_steps, asked.worlds)
        solids = env.worlds.boxes.shape[1] + env.worlds.circles.shape[1]
        for robots in asked.robots:
            for name, see in {"all": see_all, **({"no lidar": see_reward} if asked.parts else {})}.items():
                found, first = rates(env, see, robots, asked.steps, asked.rounds)
                middle = statistics.median(found)
                rows.append({"robots": robots, "control_steps": control_steps, "what": name, "solids": solids})
                rows[-1] |= {"steps_per_s": middle, "lowest": min(found), "highest": max(found), "first_s": first}
                print(
                    f"{robots:6d} robots, {control_steps:2d} control steps, {solids} solids, {name:9}"
                    f"{middle:12,.0f} steps/s ({min(found):,.0f} to {max(found):,.0f}), "
                    f"{middle * control_steps:12,.0f} control steps/s, first round {first:.0f} s",
                    flush=True,
                )
    if asked.write:
        asked.write.write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
