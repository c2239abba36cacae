"""Shots a second on tables scattered by play, as an accelerator plays them: many tables at once.

    python benchmarks/shots.py --tables 1048576 --out shots.json

Every shot begins where five shots in uniform directions left the balls, and goes in a uniform direction. Compile time
apart; the median of some repeats, each with other directions.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp

from cuelearner_envs.billiards import Table
from cuelearner_envs.billiards.physics import Shot, simulate_many
from cuelearner_envs.billiards.table import rack
from cuelearner_jax.storage.provenance import provenance


def scattered(table: Table, tables: int, block: int) -> tuple[jax.Array, jax.Array]:
    """Balls (tables, balls, 2) and which of them are pocketed, after five shots."""
    positions = jnp.broadcast_to(rack(table), (tables, table.balls, 2))
    pocketed = jnp.zeros((tables, table.balls), bool)
    for number in range(5):
        shot = play(table, positions, pocketed, jax.random.key(number), block)
        positions = jnp.where(shot.pocketed[:, :1, None], positions, shot.positions)  # a foul is taken back
        pocketed = jnp.where(shot.pocketed[:, :1], pocketed, shot.pocketed)
    return positions, pocketed


@partial(jax.jit, static_argnames="block")
def play(table: Table, positions: jax.Array, pocketed: jax.Array, key: jax.Array, block: int) -> Shot:
    """Play one shot on every table."""
    angles = jax.random.uniform(key, (len(positions),), maxval=2 * jnp.pi)
    return simulate_many(table, positions, pocketed, angles, block=block)


def main() -> None:
    """Times and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", type=int, nargs="+", default=[8192])
    parser.add_argument("--blocks", type=int, nargs="+", default=[4096, 32_768, 1_048_576], help="tables at once")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    table, rows = Table.regulation(), []
    for tables in asked.tables:
        for block in sorted({min(block, tables) for block in asked.blocks}):
            balls = scattered(table, tables, block)
            times, events = [], 0.0
            for number in range(asked.repeats):
                began = time.perf_counter()
                shot = jax.block_until_ready(play(table, *balls, jax.random.key(100 + number), block))
                times.append(time.perf_counter() - began)
                events = float(shot.events.mean())
            rows.append(
                {
                    "tables": tables,
                    "block": block,
                    "shots_a_second": tables / statistics.median(times),
                    "events_a_shot": events,
                }
            )
    print("   tables     block  shots a second  events a shot")
    for row in rows:
        print(f"{row['tables']:9,d} {row['block']:9,d} {row['shots_a_second']:15,.0f} {row['events_a_shot']:14.2f}")
    if asked.out:
        asked.out.write_text(json.dumps({**provenance(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
