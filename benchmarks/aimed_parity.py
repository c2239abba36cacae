"""Success of aims in Chipmunk, where this simulator's contact law is not exact, at the public code's step of 0.02 s.

    python benchmarks/aimed_parity.py --out aimed_parity.json

An aim (`Billiards.aims`) sends a target straight into a pocket by this simulator's own contact law and friction. A
player who takes possible aims at random meets situations here; Chipmunk plays each of these shots again, at a fine step
and at the step of the paper's public code. Printed: the share of shots that pocket the same balls, and the reward a
shot (targets pocketed; 0 if the cue ball is too). Minutes on 2 cores.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from pymunk_table import FINE_STEP, USUAL_STEP, PymunkTable

from cuelearner_envs.billiards import Table, simulate_many
from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import to_angle
from cuelearner_jax.storage.provenance import provenance

WORLDS = (BilliardsConfig("easy"), BilliardsConfig("regulation"))


def situations(env: Any, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (count, balls, 2) [m] and pocketed (count, balls) before shots at random aims, and their angles [rad]."""

    def shot(carry: tuple, key: jax.Array) -> tuple[tuple, tuple]:
        state, obs = carry
        k_aim, k_env = jax.random.split(key)
        aims = env.aims(obs)
        number = jax.random.categorical(k_aim, jnp.where(aims.possible, 0.0, -jnp.inf))
        action = jnp.where(aims.possible.any(), aims.actions[number], DIRECTIONS.sample(k_aim, ()))
        after, step = env.step(k_env, state, action)
        return (after, step.obs), (state.positions, state.pocketed, to_angle(action), aims.possible.any())

    k_reset, k_play = jax.random.split(episodes())
    start = env.reset(k_reset)
    places, pocketed, angles, aimed = jax.jit(lambda: jax.lax.scan(shot, start, jax.random.split(k_play, 2 * count)))()[
        1
    ]
    chosen = np.flatnonzero(np.asarray(aimed))[:count]
    return np.asarray(places)[chosen], np.asarray(pocketed)[chosen], np.asarray(angles)[chosen]


def in_chipmunk(table: Table, step: float, places: np.ndarray, gone: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return which balls are pocketed after each shot (count, balls), those pocketed before included."""
    world, after = PymunkTable(table, step), gone.copy()
    for number, (place, before, angle) in enumerate(zip(places, gone, angles, strict=True)):
        after[number, ~before] = world.play(place[~before], float(angle))[1]
    return after


def reward(before: np.ndarray, after: np.ndarray) -> float:
    """Targets that a shot pocketed, 0 if it pocketed the cue ball; mean over shots."""
    return float(((after & ~before)[:, 1:].sum(1) * ~after[:, 0]).mean())


def main() -> None:
    """Play the shots in both engines and prints a row a table and step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=int, default=1000)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    rows = []
    print(f"{'table':12}{'step [s]':>10}{'same pocketed':>15}{'reward here':>13}{'in Chipmunk':>13}")
    for world in WORLDS:
        env = make_environment(world)
        name, table = world.table, env.table
        places, gone, angles = situations(env, asked.shots)
        ours = np.asarray(jax.jit(simulate_many)(table, places, gone, angles).pocketed)
        for step in (FINE_STEP, USUAL_STEP):
            theirs = in_chipmunk(table, step, places, gone, angles)
            same = float((theirs == ours).all(1).mean())
            row = {"table": name, "step_s": step, "shots": len(angles), "same_pocketed": same}
            row |= {"reward": reward(gone, ours), "reward_in_chipmunk": reward(gone, theirs)}
            rows.append(row)
            told = f"{same:15.1%}{row['reward']:13.3f}{row['reward_in_chipmunk']:13.3f}"
            print(f"{name:12}{step:10g}{told}", flush=True)
    if asked.out:
        asked.out.write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
