"""Environment steps a second with automatic reset: our navigation against JaxNav of JaxMARL 0.2.0, both with a lidar.

    .venv/bin/python -m uv pip install --python .venv/bin/python --no-deps jaxmarl==0.2.0
    python benchmarks/navigation_speed.py --envs 256 2048

JaxNav needs nothing beside what this project has; `--no-deps` leaves that as it is. It gets one agent, 270 beams over
270 degrees and else its defaults: random maps of 11 m by 11 m, not checked for a way to the goal, lidar up to 6 m.
"JaxNav, 20 m" has our halls' size and our lidar's range of 10 m. Ours: halls of 20 m by 20 m, 271 beams over 270
degrees, routes that lead to the goal. Space are random. All observations are held and added up, so that none is
optimised away. "final_obs too" also holds what an episode's last step led to: a second scan, which training never asks
for and JaxNav does not offer. Rounds are interleaved; figures are medians over rounds, compile time apart. Writes
benchmarks/results/navigation_speed.json with --write.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import statistics
import time
import warnings
from collections.abc import Callable
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cuelearner_envs.navigation.config import NavigationConfig, make_environment
from cuelearner_envs.navigation.environment import Navigation
from cuelearner_jax.spaces.directions import from_angle
from cuelearner_jax.storage.provenance import provenance

RESULTS = Path(__file__).parent / "results" / "navigation_speed.json"
PEER = "JaxNav"
AGENT = "agent_0"


class System(NamedTuple):
    """An environment as the stopwatch sees it; what is seen of it is a pytree."""

    env: Any  # traced
    reset: Callable[..., Any]  # (env, key) -> state, seen
    step: Callable[..., Any]  # (env, key, state) -> state, seen, did the episode end?


def ours(env: Navigation, see: Callable[[Any], Any]) -> System:
    """Return this package's environment as a contender; `see` reads its steps."""

    def reset(env: Any, key: jax.Array) -> Any:
        k_reset, k_step = jax.random.split(key)
        state, _ = env.reset(k_reset)
        return state, see(env.step(k_step, state, jnp.array([1.0, 0.0]))[1])

    def step(env: Any, key: jax.Array, state: Any) -> Any:
        k_action, k_step = jax.random.split(key)
        direction = from_angle(jax.random.uniform(k_action, (), minval=-math.pi, maxval=math.pi))
        state, done = env.step(k_step, state, direction)
        return state, see(done), done.terminated | done.truncated

    return System(env, reset, step)


def jaxnav(**options: Any) -> System:
    """JaxNav with one agent."""
    with contextlib.redirect_stdout(None), warnings.catch_warnings():
        # It tells of environments not installed, and that its own defaults for the goal's distance are clipped.
        warnings.simplefilter("ignore")
        from jaxmarl.environments.jaxnav import JaxNav  # pyright: ignore[reportMissingImports]

        nav = JaxNav(num_agents=1, **{"lidar_num_beams": 270, "lidar_angle_factor": 0.75, **options})
    space: Any = nav.action_space(AGENT)

    def reset(_: None, key: jax.Array) -> Any:
        obs, state = nav.reset(key)
        return state, obs[AGENT]

    def step(_: None, key: jax.Array, state: Any) -> Any:
        k_action, k_step = jax.random.split(key)
        action = {AGENT: jax.random.uniform(k_action, (2,), minval=space.low, maxval=space.high)}
        obs, state, _, done, _ = nav.step(k_step, state, action)
        return state, obs[AGENT], done["__all__"]

    return System(None, reset, step)


def contenders() -> dict[str, System]:
    """Return the contenders."""
    env = make_environment(NavigationConfig(style="clutter", worlds=256))
    hall = {"map_params": {"map_size": (22, 22), "fill": 0.3}, "lidar_max_range": 10.0}
    return {
        PEER: jaxnav(),
        "JaxNav, 20 m": jaxnav(**hall),
        "ours": ours(env, lambda step: step.obs),
        "ours, final_obs too": ours(env, lambda step: (step.obs, step.final_obs)),
    }


class Race:
    """Some environments of one system side by side, stepped in one compiled loop."""

    def __init__(self, system: System, envs: int, steps: int) -> None:
        self.env, self.count = system.env, envs * steps
        self.calls = self.taken = self.ended = 0

        @jax.jit
        def start(env: Any, key: jax.Array) -> Any:
            return jax.vmap(partial(system.reset, env))(jax.random.split(key, envs))

        @jax.jit
        def run(env: Any, key: jax.Array, now: Any) -> Any:
            def one(carry: Any, key: jax.Array) -> Any:
                (state, seen), total, ends = carry
                total = total + sum(leaf.sum() for leaf in jax.tree.leaves(seen))
                state, seen, ended = jax.vmap(partial(system.step, env))(jax.random.split(key, envs), state)
                return ((state, seen), total, ends + ended.sum()), None

            return jax.lax.scan(one, (now, jnp.float32(0), jnp.int32(0)), jax.random.split(key, steps))[0]

        self.start, self.run = start, run
        self.now = start(self.env, jax.random.key(0))
        self.rate(0.0)  # compiles
        self.taken = self.ended = 0

    def rate(self, at_least: float) -> float:
        """Steps a second of a stretch of so many seconds or a little more."""
        began, calls = time.perf_counter(), 0
        while calls == 0 or time.perf_counter() - began < at_least:
            self.calls, calls = self.calls + 1, calls + 1
            self.now, total, ended = self.run(self.env, jax.random.key(self.calls), self.now)
            self.ended += int(ended)
            if not math.isfinite(float(total)):
                raise RuntimeError("an observation is not finite")
        self.taken += calls * self.count
        return calls * self.count / (time.perf_counter() - began)


def measure(systems: dict[str, System], envs: int, steps: int, repeats: int, seconds: float) -> list[dict[str, Any]]:
    """Return one row for each system at one number of environments."""
    races = {name: Race(system, envs, steps) for name, system in systems.items()}
    rates = {name: [] for name in races}
    for _ in range(repeats):
        for name, race in races.items():
            rates[name].append(race.rate(seconds))
    return [
        {
            "envs": envs,
            "system": name,
            "steps_per_second": statistics.median(seen),
            "slowest": min(seen),
            "fastest": max(seen),
            "times_jaxnav": statistics.median(mine / peer for mine, peer in zip(seen, rates[PEER], strict=True)),
            "ends_per_1000_steps": 1000 * races[name].ended / races[name].taken,
        }
        for name, seen in rates.items()
    ]


def main() -> None:
    """Race the systems and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, nargs="+", default=[256, 2048], help="side by side")
    parser.add_argument("--steps", type=int, default=8, help="of each environment in one call of the compiled loop")
    parser.add_argument("--repeats", type=int, default=7, help="interleaved rounds")
    parser.add_argument("--seconds", type=float, default=1.0, help="least duration of a timed stretch")
    parser.add_argument("--write", action="store_true", help=f"write {RESULTS.name}")
    asked = parser.parse_args()
    try:
        version = metadata.version("jaxmarl")
    except metadata.PackageNotFoundError:
        parser.error("JaxMARL is not installed: `python -m uv pip install --no-deps jaxmarl==0.2.0`")

    systems = contenders()
    rows = [row for n in asked.envs for row in measure(systems, n, asked.steps, asked.repeats, asked.seconds)]
    print(f"{os.cpu_count()} cores, JAX {jax.__version__} on {jax.devices()[0].device_kind}, JaxMARL {version}")
    print(f"{'envs':>6}  {'system':<20}{'steps/s':>10}{'slowest':>10}{'fastest':>10}{'x JaxNav':>10}{'ends/1000':>11}")
    for row in rows:
        print(
            f"{row['envs']:6}  {row['system']:<20}{row['steps_per_second']:10,.0f}{row['slowest']:10,.0f}"
            f"{row['fastest']:10,.0f}{row['times_jaxnav']:10.2f}{row['ends_per_1000_steps']:11.1f}"
        )
    if asked.write:
        came = {**provenance(), "cores": os.cpu_count(), "jaxmarl": version}
        RESULTS.write_text(json.dumps({**came, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
