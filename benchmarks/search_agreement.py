"""Loss of the rough argmax (a first look at some directions, then near its peaks) against the full one.

    python benchmarks/search_agreement.py runs/regulation --out agreement.json    # the agents of a finished run
    python benchmarks/search_agreement.py shipped --out agreement.json            # the shipped teacher's network

Against the full search in full float32: how often the choice is the same or close, how much value the rough choice
gives up as a share of the values' spread, and the reward a step on the same validation episodes. The lost reward is
paired by agent (of a single network by episode), with a 95% bootstrap interval of the mean. "all, as computed by
default" is the full search at the device's own float32, which on a GPU rounds the factors of its products to 10 bits.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from flax import struct

import cuelearner_jax as cl
from cuelearner_jax import teachers
from cuelearner_jax.agents import ddqn
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.evaluate import episodes, rollout
from cuelearner_jax.policies import BY_LANE, SHARED, PolicyNode
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.spaces import directions as geometry
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry
from cuelearner_jax.tasks.billiards import SHIPPED_TEACHERS

STATES = 256  # of an agent
ENVS = 100  # that share an evaluation's steps
NAMES = ("same", "neighbouring", "within_half_a_degree", "value_given_up", "reward")
SHIPPED = "shipped"
TABLE = "regulation"  # of the shipped network


class Searching(PolicyNode):
    """An agent that searches as its options say, roughly or fully; a finished one always searches fully."""

    params: Any
    functions: ddqn.DoubleDQN = struct.field(pytree_node=False)
    env: Any

    def act(self, key: jax.Array, states: Any, obs: jax.Array) -> jax.Array:
        """The action with the largest value that the search finds."""
        return self.functions.explore(self.env, self.functions.options, self.params, obs, key)

    @property
    def axes(self) -> Any:
        """Each lane has its own network."""
        return self.replace(params=BY_LANE, env=SHARED)


class Agents(NamedTuple):
    """The agents of one source."""

    env: Any  # of the validation episodes
    functions: Any  # a DoubleDQN
    params: Any  # leading axis: agents
    told: dict[str, Any]  # about them, for the record


def shipped() -> Agents:
    """The shipped teacher's network, which expects a reward of every direction, as one agent."""
    world = cl.make("billiards", table=TABLE)
    network = teachers.load(SHIPPED_TEACHERS / TABLE, world.env, 0.0, 0.0)
    params = jax.tree.map(lambda leaf: leaf[None], network.params)
    functions = ddqn.Config(q_layers=network.layers).make("action", spaces_of(world.env))
    return Agents(world.environment("validation"), functions, params, {"network": TABLE})


def of_run(folder: Path) -> Agents:
    """The agents of a run's first kind of guidance, as its newest checkpoint has them."""
    source = PolicySource.of_run(folder, registry.find)
    assert source.grid is not None
    config, lanes = source.config, source.load(source.grid.guidance[:1])[0]
    env = source.task.environment(config.task, "validation")
    about = {"step": lanes.step, "seeds": lanes.seeds.tolist()}
    return Agents(env, config.agent_in(env), lanes.policies["params"], about)


def met(agent: Searching) -> jax.Array:
    """Observations (STATES, obs) that an agent meets after a few steps of its own play."""
    env = agent.env
    state, obs = jax.vmap(env.reset)(jax.random.split(episodes("tuning"), STATES))

    def step(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        state, obs = carry
        after, made = jax.vmap(env.step)(jax.random.split(key, STATES), state, agent.act(key, state, obs))
        return (after, made.obs), None

    return jax.lax.scan(step, (state, obs), jax.random.split(jax.random.key(1), 5))[0][1]


def compare(agents: Agents, way: ddqn.Config, steps: int, precise: bool) -> dict[str, np.ndarray]:
    """Compare one search with the full one: NAMES, each (agents,), and "rewards" (agents, parts of the episodes)."""
    env, options = agents.env, geometry.evenly_spaced(way.directions)
    searching = dataclasses.replace(agents.functions, options=way)
    full = dataclasses.replace(searching, options=dataclasses.replace(way, coarse_directions=0))

    def one(params: Any) -> dict[str, jax.Array]:
        obs = met(Searching(params, full, env))
        with jax.default_matmul_precision("highest"):
            found = jax.lax.map(lambda seen: full.value(env, params, seen, options), obs, batch_size=16)
        with jax.default_matmul_precision("highest" if precise else "default"):
            agent = Searching(params, searching, env)
            chosen = agent.act(jax.random.key(0), None, obs)
            keys = jax.random.split(episodes(), ENVS)
            rewards = jax.lax.map(
                lambda key: rollout(agent, env, key, 10, steps // ENVS)["reward"], keys, batch_size=10
            )
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
            "reward": rewards.mean(),
            "rewards": rewards,
        }

    return jax.device_get(jax.jit(partial(jax.lax.map, one))(agents.params))


def ways(
    sizes: ddqn.Config, coarse: list[int], peaks: list[int], dtypes: list[Any]
) -> Iterator[tuple[str, ddqn.Config, bool]]:
    """(what the search is called, options, in full float32?), the full search first."""
    full = dataclasses.replace(sizes, coarse_directions=0)
    yield "all, in full float32", full, True
    yield "all, as computed by default", full, False
    for first in coarse:
        for dtype in dtypes:
            for count in peaks:
                way = dataclasses.replace(full, coarse_directions=first, coarse_dtype=dtype, peaks=count)
                yield f"{first} in {dtype}, {count} peaks", way, False


def lost(best: np.ndarray, rewards: np.ndarray) -> list[float]:
    """Reward lost against the full search: [mean, lower, upper], paired by agent, of one agent by parts of episodes."""
    pairs = (best - rewards).mean(-1) if len(best) > 1 else (best - rewards)[0]
    if not pairs.any():
        return [0.0, 0.0, 0.0]
    bounds = scipy.stats.bootstrap((pairs,), np.mean, rng=np.random.default_rng(0)).confidence_interval
    return [float(pairs.mean()), float(bounds.low), float(bounds.high)]


def main() -> None:
    """Compare and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("of", help=f"a finished run's folder with its checkpoint, or {SHIPPED}")
    parser.add_argument("--coarse", type=int, nargs="+", default=[360, 720, 1200])
    parser.add_argument("--peaks", type=int, nargs="+", default=[4, 8, 16])
    parser.add_argument("--dtypes", nargs="+", default=["float32", "bfloat16"], choices=["float32", "bfloat16"])
    parser.add_argument("--steps", type=int, default=10_000, help="environment steps of an agent, a multiple of 1000")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    agents = shipped() if asked.of == SHIPPED else of_run(Path(asked.of))
    rows, best = [], None
    print(f"{'search':28s}  " + "  ".join(f"{name:>20}" for name in NAMES) + "  reward lost [95%]")
    for name, way, precise in ways(agents.functions.options, asked.coarse, asked.peaks, asked.dtypes):
        found = compare(agents, way, asked.steps, precise)
        best = found["rewards"] if best is None else best
        row = {"search": name, **{part: float(found[part].mean()) for part in NAMES}}
        row |= {"reward_by_agent": found["reward"].tolist(), "reward_lost": lost(best, found["rewards"])}
        rows.append(row)
        mean, low, high = row["reward_lost"]
        told = "  ".join(f"{row[part]:>20.5f}" for part in NAMES)
        print(f"{name:28s}  {told}  {mean:.4f} [{low:.4f}, {high:.4f}]", flush=True)
        if asked.out:
            record = {**provenance(), **agents.told, "steps": asked.steps, "rows": rows}
            asked.out.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
