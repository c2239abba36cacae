"""Soft actor-critic here over that of sbx: return over steps, and steps over seconds, on tasks of Gymnasium.

    python benchmarks/sac_speed.py --environments Hopper-v5 Ant-v5 --peer-python peers/bin/python --out sac.json
    python benchmarks/sac_speed.py --environments pendulum --seeds 64 --steps 20000 --out sac.json
    python benchmarks/sac_speed.py --table sac.json

Ways: `sac` and `xqc` (the same with `--agent.bins`) here, all seeds side by side; sbx's `SAC` and `CrossQ`, a process
a seed, one after another or `--at-once` some. SAC has the same networks, minibatches, updates a step, rates, discount,
target entropy and random steps here and there; CrossQ has its own defaults. `pendulum` is Gymnasium's Pendulum-v1,
which `pendulum.py` is step for step. Seconds are of training alone, without a training's first stretch, which compiles.

Every evaluation is written when all seeds have it; a way that is in `--out` in full is not repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _measuring import timed
from pendulum import STEPS, Pendulum

import cuelearner_jax as cl
from cuelearner_jax.agents import sac
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.devices import SHARED, lane_mesh, place
from cuelearner_jax.loop import start_clock
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.storage.provenance import provenance

PENDULUM = "pendulum"
OURS, PEERS = ("sac", "xqc"), ("SAC", "CrossQ")
LENGTH = 1000  # of the longest episode
Tell = Callable[[dict[str, Any]], None]  # takes an evaluation: step, returns (seeds), seconds of the stretch before it


@dataclass(frozen=True)
class Setting:
    """Settings that all implementations of SAC share."""

    layers: tuple[int, ...]
    batch_size: int
    updates_per_step: int
    prefill: int
    steps: int
    evaluations: int
    episodes: int = 10
    discount: float = 0.99
    rate: float = 3e-4
    polyak: float = 0.005

    @property
    def every(self) -> int:
        """Steps between two evaluations."""
        return self.steps // self.evaluations


def configuration(setting: Setting, way: str) -> RunConfig:
    """Return this package's options."""
    agent = sac.SACConfig(
        actor_layers=setting.layers,
        critic_layers=setting.layers,
        bins=way == "xqc",
        batch_size=setting.batch_size,
        updates_per_step=setting.updates_per_step,
        replay_capacity=setting.steps,
        actor_rate=setting.rate,
        critic_rate=setting.rate,
        temperature_rate=setting.rate,
        polyak=setting.polyak,
    )
    schedule = Schedule(random_steps=setting.prefill, learn_after=setting.prefill, guidance_until=0)
    scalars = Scalars(discount=setting.discount, max_grad_norm=1e9)  # the peers do not clip
    return RunConfig(None, Sizes(num_envs=1), scalars, schedule, agent)


def evaluation(env: Any, functions: Any, setting: Setting, length: int) -> Callable[[Any], jax.Array]:
    """Return a function of lanes' parameters: the mean return of deterministic episodes of each."""

    def one(params: Any) -> jax.Array:
        state, obs = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), setting.episodes))

        def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
            state, obs, running, total = carry
            actions = functions.act(env, params, obs, key)
            state, after = jax.vmap(env.step)(jax.random.split(key, setting.episodes), state, actions)
            total = total + jnp.where(running, after.reward, 0.0)
            return (state, after.obs, running & ~(after.terminated | after.truncated), total), None

        start = (state, obs, jnp.ones(setting.episodes, bool), jnp.zeros(setting.episodes))
        return jax.lax.scan(step, start, jax.random.split(jax.random.key(2), length))[0][3].mean()

    return jax.jit(lambda params: jax.lax.map(one, params, batch_size=16))


def ours(name: str, way: str, setting: Setting, seeds: int, tell: Tell) -> None:
    """Train with this package's loop, that of `cuelearner sweep`, all seeds side by side."""
    env: Any = Pendulum(jnp.array(STEPS)) if name == PENDULUM else cl.from_gymnasium(name, processes=1).env
    mesh, config = lane_mesh(), configuration(setting, way)
    env = place(mesh, env, SHARED)
    functions, guide = config.agent_in(env), config.guide_in(env, "none")
    returned = evaluation(env, functions, setting, STEPS if name == PENDULUM else LENGTH)
    group = LaneGroup(config, env, guide, Grid(("none",), tuple(range(seeds)), (0,)), mesh)
    clock, blocks = place(mesh, start_clock(), SHARED), group.start()
    for number in range(setting.evaluations):
        seconds, (clock, blocks, _) = timed(lambda c=clock, b=blocks: group.train(c, b, setting.every))
        earned = np.concatenate([np.asarray(returned(block.agent.params)) for block in blocks])[:seeds]
        tell({"step": (number + 1) * setting.every, "returns": earned.tolist(), "seconds": seconds})


def peers(name: str, way: str, setting: Setting, seeds: int, python: str, at_once: int, tell: Tell) -> None:
    """Train with sbx in another Python, a process a seed."""
    ends: dict[int, dict[int, dict[str, float]]] = {}  # by step and seed

    def run(seed: int) -> None:
        values = json.dumps({**asdict(setting), "seed": seed, "name": "Pendulum-v1" if name == PENDULUM else name})
        command = [python, str(Path(__file__).parent / "_sac_peers.py"), way, values]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for line in process.stdout or ():
                if not line.startswith("{"):
                    continue
                row = json.loads(line)
                at = ends.setdefault(row["step"], {})
                at[seed] = row
                if len(at) == seeds:
                    of = {end: [at[seed][end] for seed in range(seeds)] for end in ("return", "seconds")}
                    tell({"step": row["step"], "returns": of["return"], "seconds": sum(of["seconds"])})
        if process.returncode:
            raise SystemExit(f"sbx failed on {name}: is it installed (pip install sbx-rl) in {python}?")

    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(run, range(seeds)))


def show(rows: list[dict[str, Any]]) -> None:
    """Print a table: returns of every way at the last common step, over sbx's SAC, and steps a second of all seeds."""
    print("environment       way       step   return, mean [seeds' least, most]    over sbx's SAC   steps/s, all seeds")
    for name in dict.fromkeys(row["environment"] for row in rows):
        own = [row for row in rows if row["environment"] == name and row["rows"]]
        step = min(row["rows"][-1]["step"] for row in own)
        at = {row["way"]: next(r["returns"] for r in row["rows"] if r["step"] == step) for row in own}
        for row in own:
            returns, later = at[row["way"]], row["rows"][1:]
            over = f"{np.mean(returns) / np.mean(at['SAC']):.2f}" if "SAC" in at else "-"
            stretch = row["rows"][0]["step"] * len(returns) * len(later)
            rate = stretch / sum(r["seconds"] for r in later) * row["at_once"] if later else np.nan
            spread = f"{np.mean(returns):.0f} [{min(returns):.0f}, {max(returns):.0f}]"
            print(f"{name:<18}{row['way']:<8}{step:>8,}   {spread:<36}{over:>14}   {rate:>12,.0f}")


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environments", nargs="+", default=[PENDULUM], help="of Gymnasium (default: its pendulum)")
    parser.add_argument("--ways", nargs="+", default=[*OURS, *PEERS], choices=(*OURS, *PEERS))
    parser.add_argument("--peer-python", default=sys.executable, help="a Python with sbx")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--at-once", type=int, default=1, help="seeds of a peer that run side by side (default: 1)")
    parser.add_argument("--steps", type=int, default=300_000, help="of each training (default: 300,000)")
    parser.add_argument("--evaluations", type=int, default=6, help="of each training (default: 6)")
    parser.add_argument("--prefill", type=int, default=5_000, help="random steps before the first update")
    parser.add_argument("--layers", type=int, nargs="+", default=[256, 256])
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--updates-per-step", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file to write, or to go on with")
    parser.add_argument("--table", type=Path, nargs="+", help="print the table of these files, and measure nothing")
    return parser.parse_args()


def main() -> None:
    """Measure, print and write."""
    options = arguments()
    if options.table:
        show([row for file in options.table for row in json.loads(file.read_text())["rows"]])
        return
    if options.evaluations < 2 or options.steps % options.evaluations:
        raise SystemExit("give at least two evaluations that divide --steps")
    setting = Setting(
        tuple(options.layers),
        options.batch_size,
        options.updates_per_step,
        options.prefill,
        options.steps,
        options.evaluations,
    )
    rows = json.loads(options.out.read_text())["rows"] if options.out and options.out.exists() else []
    rows = [row for row in rows if len(row["rows"]) == options.evaluations]
    for name in options.environments:
        for way in options.ways:
            if any((row["environment"], row["way"]) == (name, way) for row in rows):
                continue
            at_once = 1 if way in OURS else min(options.at_once, options.seeds)
            entry: dict[str, Any] = {"environment": name, "way": way, "at_once": at_once, "rows": []}
            rows.append(entry)

            def tell(row: dict[str, Any], entry: dict[str, Any] = entry) -> None:
                entry["rows"].append(row)
                mean = f"{np.mean(row['returns']):.1f} at step {row['step']:,}, {row['seconds']:.0f} s"
                print(f"{entry['environment']}, {entry['way']}: {mean}", flush=True)
                if options.out:
                    about = {**provenance(), "processors": os.cpu_count(), "setting": asdict(setting), "rows": rows}
                    options.out.write_text(json.dumps(about, indent=1) + "\n")

            if way in OURS:
                ours(name, way, setting, options.seeds, tell)
            else:
                peers(name, way, setting, options.seeds, options.peer_python, options.at_once, tell)
    show(rows)


if __name__ == "__main__":
    main()
