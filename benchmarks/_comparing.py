"""Agents here beside those of other projects: train, evaluate, print and write, for `sac_speed.py` and `dqn_speed.py`.

Here all seeds train side by side. A peer is a process a seed, one after another or `--at-once` some, or one process of
all seeds. Seconds are of training alone, without a training's first stretch, which compiles.

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
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _measuring import Timed
from classic_control import TASKS

import cuelearner_jax as cl
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks.simulators import playground_task

LONGEST = 1000  # steps of the longest episode
Tell = Callable[[dict[str, Any]], None]  # takes an evaluation: step, returns (seeds), seconds of the stretch before it


def evaluation(env: Any, functions: Any, episodes: int = 10) -> Callable[[Any], jax.Array]:
    """Return a function of lanes' parameters: the mean return of deterministic episodes of each.

    All step until the last episode ends: Gymnasium's environment plays a lane that stands still again at each step.
    """

    def play(params: Any) -> jax.Array:
        shape = (len(jax.tree.leaves(params)[0]), episodes)
        keys_of = lambda key: jnp.broadcast_to(jax.random.split(key, episodes), shape)  # noqa: E731
        state, obs = jax.vmap(jax.vmap(env.reset))(keys_of(jax.random.key(1)))

        def step(carry: Any) -> Any:
            number, state, obs, running, total = carry
            key = jax.random.fold_in(jax.random.key(2), number)
            actions = jax.vmap(lambda own, obs: functions.act(env, own, obs, key))(params, obs)
            state, after = jax.vmap(jax.vmap(env.step))(keys_of(key), state, actions)
            total = total + jnp.where(running, after.reward, 0.0)
            return number + 1, state, after.obs, running & ~(after.terminated | after.truncated), total

        start = (0, state, obs, jnp.ones(shape, bool), jnp.zeros(shape))
        return jax.lax.while_loop(lambda carry: (carry[0] < LONGEST) & carry[3].any(), step, start)[4].mean(-1)

    return jax.jit(play)


def environment(name: str, options: argparse.Namespace) -> Any:
    """Return a task of `classic_control.py`, MuJoCo Playground (`playground:NAME`) or Gymnasium."""
    if name in TASKS:
        return TASKS[name]
    if not name.startswith("playground:"):
        return cl.from_gymnasium(name, processes=options.processes).env
    task = playground_task(name.removeprefix("playground:"))
    return task.environment(task.configure(overrides=tuple(options.overrides)))


def train_here(name: str, config: RunConfig, options: argparse.Namespace, tell: Tell) -> None:
    """Train with this package's loop, that of `cuelearner sweep`, all seeds side by side."""
    env = environment(name, options)
    lanes = Timed(config, env, "none", options.seeds)
    returned = evaluation(env, config.agent_in(env), options.episodes)
    every = options.steps // options.evaluations
    for number in range(options.evaluations):
        seconds = lanes.train(every // config.sizes.num_envs)
        earned = np.concatenate([np.asarray(returned(block.agent.params)) for block in lanes.blocks])
        tell({"step": (number + 1) * every, "returns": earned[: options.seeds].tolist(), "seconds": seconds})


def train_elsewhere(way: str, values: dict[str, Any], options: argparse.Namespace, at_once: int, tell: Tell) -> None:
    """Train a peer in its own Python: a process a seed, or one of all seeds where `values` say "together"."""
    ends: dict[int, dict[int, dict[str, Any]]] = {}  # by step and process
    seeds = list(range(options.seeds))
    parts = [seeds] if values.get("together") else [[seed] for seed in seeds]

    def run(number: int) -> None:
        setting = json.dumps({**values, "seeds": parts[number]})
        command = [options.peer_python, str(Path(__file__).parent / "_peers.py"), way, setting]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            for line in process.stdout or ():
                if not line.startswith("{"):
                    continue
                row = json.loads(line)
                at = ends.setdefault(row["step"], {})
                at[number] = row
                if len(at) == len(parts):
                    returns = [earned for part in range(len(parts)) for earned in at[part]["returns"]]
                    seconds = sum(row["seconds"] for row in at.values())
                    tell({"step": row["step"], "returns": returns, "seconds": seconds})
        if process.returncode:
            raise SystemExit(f"{way} failed on {values['name']}: is it installed in {options.peer_python}?")

    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(run, range(len(parts))))


def show(rows: list[dict[str, Any]], base: str) -> None:
    """Print a table: returns of every way at the last common step, over the base's, and steps a second of all seeds."""
    print(f"environment    way            step   return, mean [seeds' least, most]   over {base}   steps/s, all seeds")
    for name in dict.fromkeys(row["environment"] for row in rows):
        own = [row for row in rows if row["environment"] == name and row["rows"]]
        step = min(row["rows"][-1]["step"] for row in own)
        at = {row["way"]: next(r["returns"] for r in row["rows"] if r["step"] == step) for row in own}
        own_base = np.mean(at.get(base, 0.0))  # a share of a negative return says nothing
        for row in own:
            returns, later = at[row["way"]], row["rows"][1:]
            over = f"{np.mean(returns) / own_base:.2f}" if own_base > 0 else "-"
            stretch = row["rows"][0]["step"] * sum(len(r["returns"]) for r in later)
            rate = stretch / sum(r["seconds"] for r in later) * row["at_once"] if later else np.nan
            spread = f"{np.mean(returns):.0f} [{min(returns):.0f}, {max(returns):.0f}]"
            print(f"{name:<14} {row['way']:<10}{step:>9,}   {spread:<32}{over:>10}   {rate:>16,.0f}")


def parser_of(about: str | None, environments: list[str], ways: list[str], seeds: int) -> argparse.ArgumentParser:
    """Return a command line with the options that every comparison has."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environments", nargs="+", default=environments, help="of Gymnasium")
    parser.add_argument("--ways", nargs="+", default=ways, choices=ways)
    parser.add_argument("--peer-python", default=sys.executable, help="a Python with the peers")
    parser.add_argument("--seeds", type=int, default=seeds)
    parser.add_argument("--at-once", type=int, default=1, help="seeds of a peer that run side by side (default: 1)")
    parser.add_argument("--overrides", nargs="+", default=[], help="of Playground, as those of --task.overrides")
    parser.add_argument("--steps", type=int, default=500_000, help="of each training (default: 500,000)")
    parser.add_argument("--processes", type=int, default=1, help="that play our environments (default: 1)")
    parser.add_argument("--evaluations", type=int, default=5, help="of each training (default: 5)")
    parser.add_argument("--episodes", type=int, default=10, help="of an evaluation, for each seed (default: 10)")
    parser.add_argument("--out", type=Path, help="JSON file to write, or to go on with")
    parser.add_argument("--table", type=Path, nargs="+", help="print the table of these files, and measure nothing")
    return parser


def compare(
    options: argparse.Namespace,
    setting: dict[str, Any],
    here: dict[str, RunConfig],
    elsewhere: dict[str, dict[str, Any]],
    base: str,
) -> None:
    """Measure, print and write. `elsewhere`: by way, what its process gets beside the environment and the sizes."""
    if options.table:
        show([row for file in options.table for row in json.loads(file.read_text())["rows"]], base)
        return
    if options.evaluations < 2 or options.steps % (options.evaluations * setting.get("envs", 1)):
        raise SystemExit("give at least two evaluations that divide --steps, each a multiple of --envs")
    rows = json.loads(options.out.read_text())["rows"] if options.out and options.out.exists() else []
    rows = [row for row in rows if len(row["rows"]) == options.evaluations]
    setting |= {name: getattr(options, name) for name in ("steps", "evaluations", "episodes", "overrides")}
    for name in options.environments:
        for way in options.ways:
            if any((row["environment"], row["way"]) == (name, way) for row in rows):
                continue
            alone = way in here or elsewhere[way].get("together")
            at_once = 1 if alone else min(options.at_once, options.seeds)
            entry: dict[str, Any] = {"environment": name, "way": way, "at_once": at_once, "rows": []}
            rows.append(entry)

            def tell(row: dict[str, Any], entry: dict[str, Any] = entry) -> None:
                entry["rows"].append(row)
                mean = f"{np.mean(row['returns']):.1f} at step {row['step']:,}, {row['seconds']:.0f} s"
                print(f"{entry['environment']}, {entry['way']}: {mean}", flush=True)
                if options.out:
                    about = {**provenance(), "processors": os.cpu_count(), "setting": setting, "rows": rows}
                    options.out.write_text(json.dumps(about, indent=1) + "\n")

            if way in here:
                train_here(name, here[way], options, tell)
            else:
                train_elsewhere(way, {**setting, **elsewhere[way], "name": name}, options, at_once, tell)
    show(rows, base)
