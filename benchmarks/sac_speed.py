"""Soft actor-critic here over brax's, Stable-Baselines3's and sbx's: return over steps, and steps over seconds.

    python benchmarks/sac_speed.py --peer-python peers/bin/python --out benchmarks/results/sac_speed.json
    python benchmarks/sac_speed.py --environments halfcheetah --seeds 64 --ways brax --out sac_speed_h200.json

All ways have the same networks, minibatches, updates a step, learning rates, discount and target entropy (-0.5 an
entry, which brax fixes), and as many steps before the first update: uniform actions here and in Stable-Baselines3,
brax's untrained actor there. brax's SAC runs in brax's environments and in the pendulum (`_brax_pendulum.py`). The
packages of Gymnasium run in Gymnasium's Pendulum-v1, which `pendulum.py` is step for step.

Ways take turns within one run: each turn is a whole training with a seed of its own. Seconds are of training alone,
without evaluations, and without each training's first stretch, which compiles. `--seeds 64` trains as many seeds here
side by side, against one of the peer; its steps a second are then those of all seeds.

A peer that is not installed is skipped with a line. Give `--peer-python` a Python with sbx (`pip install sbx-rl`).
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _brax_pendulum import BraxPendulum, wrap
from _measuring import timed
from pendulum import STEPS, Pendulum

from cuelearner_jax.agents import sac
from cuelearner_jax.bridges.brax import from_brax, supply_device_put_replicated
from cuelearner_jax.config import Scalars, Schedule, Sizes
from cuelearner_jax.devices import SHARED, lane_mesh, place
from cuelearner_jax.loop import start_clock
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.storage.provenance import provenance

PENDULUM = "pendulum"
ENVIRONMENTS = (PENDULUM, "inverted_pendulum", "reacher", "halfcheetah")
PEERS = ("brax", "sb3", "sbx")
OURS = "ours"
LENGTH = 1000  # of an episode in brax's environments
Rows = list[dict[str, float]]  # of one training: step, return, seconds of the stretch before, steps of that stretch
Way = Callable[[int], Rows]  # by the seed


@dataclass(frozen=True)
class Setting:
    """Settings that all implementations share."""

    layers: tuple[int, ...] = (256, 256)
    batch_size: int = 256
    updates_per_step: int = 1
    prefill: int = 1_000
    steps: int = 20_000
    evaluations: int = 10
    episodes: int = 10
    discount: float = 0.99
    rate: float = 3e-4
    polyak: float = 0.005

    @property
    def every(self) -> int:
        """Steps between two evaluations."""
        return self.steps // self.evaluations


def environment_of(name: str, backend: str) -> tuple[Any, Any, int]:
    """Return this package's environment, brax's, and the steps of an episode."""
    supply_device_put_replicated()
    if name == PENDULUM:
        return Pendulum(jnp.array(STEPS)), BraxPendulum(), STEPS
    from brax import envs

    env = envs.get_environment(name, backend=backend)
    return from_brax(env, max_steps=LENGTH), env, LENGTH


def configuration(setting: Setting) -> RunConfig:
    """Return this package's options."""
    agent = sac.SacConfig(
        actor_layers=setting.layers,
        critic_layers=setting.layers,
        batch_size=setting.batch_size,
        updates_per_step=setting.updates_per_step,
        replay_capacity=setting.steps,
        actor_rate=setting.rate,
        critic_rate=setting.rate,
        target_entropy=-0.5,
        polyak=setting.polyak,
    )
    schedule = Schedule(random_steps=setting.prefill, learn_after=setting.prefill, guidance_until=0)
    scalars = Scalars(discount=setting.discount, max_grad_norm=1e9)  # the peers do not clip
    return RunConfig(None, Sizes(num_envs=1), scalars, schedule, agent)


def ours(env: Any, setting: Setting, seeds: int, length: int) -> Way:
    """Return this package's loop, that of `cuelearner sweep`, with several seeds side by side."""
    mesh, config = lane_mesh(), configuration(setting)
    env = place(mesh, env, SHARED)
    functions, guide = config.agent_in(env), config.guide_in(env, "none")

    @jax.jit
    def returned(params: Any) -> jax.Array:
        def one(params: Any) -> jax.Array:
            state, obs = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), setting.episodes))

            def step(carry: Any, key: jax.Array) -> tuple[Any, None]:
                state, obs, running, total = carry
                actions = functions.act(env, params, obs, key)
                state, found = jax.vmap(env.step)(jax.random.split(key, setting.episodes), state, actions)
                total = total + jnp.where(running, found.reward, 0.0)
                return (state, found.obs, running & ~(found.terminated | found.truncated), total), None

            start = (state, obs, jnp.ones(setting.episodes, bool), jnp.zeros(setting.episodes))
            return jax.lax.scan(step, start, jax.random.split(jax.random.key(2), length))[0][3].mean()

        return jax.lax.map(one, params, batch_size=16)

    def train(seed: int) -> Rows:
        grid = Grid(("none",), tuple(range(seed * seeds, (seed + 1) * seeds)), (0,))
        group = LaneGroup(config, env, guide, grid, mesh)
        clock, blocks, rows = place(mesh, start_clock(), SHARED), group.start(), []
        for number in range(setting.evaluations):
            seconds, (clock, blocks, _) = timed(lambda c=clock, b=blocks: group.train(c, b, setting.every))
            earned = np.mean([np.mean(returned(block.agent.params)) for block in blocks])
            own = {"step": (number + 1) * setting.every, "return": float(earned)}
            rows.append({**own, "seconds": seconds, "steps": setting.every})
        return rows

    return train


def of_brax(env: Any, setting: Setting, length: int, own: bool) -> Way:
    """brax's SAC; `own`: the environment is our pendulum."""
    from brax.training.agents.sac import networks, train

    factory: Any = functools.partial(networks.make_sac_networks, hidden_layer_sizes=setting.layers)
    steps = -(-(setting.steps - setting.prefill) // setting.evaluations)  # between two evaluations

    def run(seed: int) -> Rows:
        rows: Rows = []

        def progress(step: int, metrics: Any) -> None:
            if step:
                own = {"step": step, "return": float(metrics["eval/episode_reward"])}
                rows.append({**own, "seconds": steps / float(metrics["training/sps"]), "steps": steps})

        train.train(
            env,
            num_timesteps=setting.steps,
            episode_length=length,
            wrap_env_fn=wrap if own else None,
            num_envs=1,
            num_eval_envs=setting.episodes,
            learning_rate=setting.rate,
            discounting=setting.discount,
            seed=seed,
            batch_size=setting.batch_size,
            num_evals=setting.evaluations + 1,
            tau=setting.polyak,
            min_replay_size=setting.prefill,
            max_replay_size=setting.steps,
            grad_updates_per_step=setting.updates_per_step,
            deterministic_eval=True,
            max_devices_per_host=1,
            network_factory=factory,
            progress_fn=progress,
        )
        return rows

    return run


def of_gymnasium(library: str, python: str, setting: Setting) -> Way | None:
    """A package of Gymnasium in another Python; None, with a line, where it is not installed there."""
    package = {"sb3": "stable_baselines3", "sbx": "sbx"}[library]
    told = f"import importlib.util as i; raise SystemExit(not i.find_spec({package!r}))"
    found = subprocess.run([python, "-c", told], capture_output=True, check=False)
    if found.returncode:
        print(f"skipped: {python} has no {package}; give --peer-python one that has", flush=True)
        return None

    def run(seed: int) -> Rows:
        told = json.dumps({**asdict(setting), "seed": seed})
        command = [python, str(Path(__file__).parent / "_sac_peers.py"), library, told]
        lines = subprocess.run(command, capture_output=True, text=True, check=False)
        if lines.returncode:
            raise SystemExit(f"{library} failed: {lines.stderr.strip().splitlines()[-1:]}")
        return [json.loads(line) for line in lines.stdout.splitlines() if line.startswith("{")]

    return run


def ways_of(name: str, asked: argparse.Namespace, setting: Setting) -> dict[str, Way]:
    """Return this package's implementation, and those of the peers asked for that are installed."""
    env, its, length = environment_of(name, asked.backend)
    ways: dict[str, Way] = {OURS: ours(env, setting, asked.seeds, length)}
    if "brax" in asked.ways:
        ways["brax"] = of_brax(its, setting, length, own=name == PENDULUM)
    for library in ("sb3", "sbx"):
        if library in asked.ways and name == PENDULUM:
            here = importlib.util.find_spec("stable_baselines3") is not None and library == "sb3"
            way = of_gymnasium(library, sys.executable if here else asked.peer_python, setting)
            ways |= {} if way is None else {library: way}
    return ways


def summary(trainings: dict[str, list[Rows]], seeds: int) -> dict[str, Any]:
    """Medians over turns of steps a second and of returns, and ours over each peer's.

    A training's first stretch, which compiles and has the random steps, counts for no speed.
    """
    rates = {}
    for way, turns in trainings.items():
        at_once = seeds if way == OURS else 1
        each = [at_once * row["steps"] / row["seconds"] for rows in turns for row in rows[1:]]
        rates[way] = float(np.median(each))
    curves = {
        way: np.median([[row["return"] for row in rows] for rows in turns], 0).round(1).tolist()
        for way, turns in trainings.items()
    }
    return {
        "steps_a_second": {way: round(rate, 1) for way, rate in rates.items()},
        "ratio": {way: round(rates[OURS] / rate, 3) for way, rate in rates.items() if way != OURS},
        "steps": {way: [int(row["step"]) for row in turns[0]] for way, turns in trainings.items()},
        "median_return": curves,
    }


def measured(name: str, asked: argparse.Namespace, setting: Setting) -> dict[str, Any]:
    """Return the measurements of all implementations, taken in turns on one environment."""
    ways = ways_of(name, asked, setting)
    trainings: dict[str, list[Rows]] = {way: [] for way in ways}
    for turn in range(asked.turns):
        for way, train in ways.items():
            trainings[way].append(train(turn))
            last = trainings[way][-1][-1]
            print(f"{name}, turn {turn + 1}: {way} returns {last['return']:.1f} at step {last['step']:,}", flush=True)
    found = summary(trainings, asked.seeds)
    return {"environment": name, "seeds": asked.seeds, **found, "trainings": trainings}


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environments", nargs="+", default=list(ENVIRONMENTS), choices=list(ENVIRONMENTS))
    parser.add_argument("--ways", nargs="*", default=list(PEERS), choices=list(PEERS), help="peers (default: all)")
    parser.add_argument("--backend", default="generalized", help="brax's physics (default: generalized)")
    parser.add_argument("--peer-python", default=sys.executable, help="a Python with sbx or stable_baselines3")
    parser.add_argument("--seeds", type=int, default=1, help="trained here side by side (default: 1)")
    parser.add_argument("--turns", type=int, default=3, help="trainings of each way (default: 3)")
    parser.add_argument("--steps", type=int, default=20_000, help="of each training (default: 20,000)")
    parser.add_argument("--evaluations", type=int, default=10, help="of each training (default: 10)")
    parser.add_argument("--prefill", type=int, default=1_000, help="steps before the first update (default: 1,000)")
    parser.add_argument("--layers", type=int, nargs="+", default=[256, 256])
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--updates-per-step", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    return parser.parse_args()


def main() -> None:
    """Measure, print and write."""
    asked = arguments()
    setting = replace(
        Setting(),
        layers=tuple(asked.layers),
        batch_size=asked.batch_size,
        updates_per_step=asked.updates_per_step,
        prefill=asked.prefill,
        steps=asked.steps,
        evaluations=asked.evaluations,
    )
    if asked.evaluations < 2 or asked.steps % asked.evaluations or asked.prefill >= setting.every:
        raise SystemExit(
            "give at least two evaluations that divide --steps, and less --prefill than steps between them"
        )
    rows = []
    for name in asked.environments:
        rows.append(measured(name, asked, setting))
        told = {key: value for key, value in rows[-1].items() if key != "trainings"}
        print(json.dumps(told, indent=1), flush=True)
        for way, ratio in rows[-1]["ratio"].items():
            print(f"{name}: {ratio:.2f} times {way}'s steps a second, with {asked.seeds} seeds", flush=True)
        if asked.out:
            about = {**provenance(), "processors": os.cpu_count(), "setting": asdict(setting), "rows": rows}
            asked.out.write_text(json.dumps(about, indent=1) + "\n")


if __name__ == "__main__":
    main()
