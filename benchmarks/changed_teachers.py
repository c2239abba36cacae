"""Whether the billiards teacher that tries shots near a network's proposals is as good as trying every direction.

    python benchmarks/changed_teachers.py --out changed_teachers.json

On situations that it meets itself in each changed world (tuning episodes), against the search of all directions: how
often both choose the same, how much of the best expected reward its choice has, and that of the learned teacher's own
choice from before the change. Minutes on one core.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.teacher import LocalSearchTeacher, SearchTeacher
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import expected_values, to_angle
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks.billiards import SCENARIOS, make_teacher

SHOTS = 4  # played before a situation is one of those that are looked at, none to three


@jax.jit
def met(env: Any, teacher: LocalSearchTeacher, key: Any, tables: Any) -> Any:
    """A situation of each table (tables,), after none to three of the teacher's shots."""
    state, obs = jax.vmap(env.reset)(jax.random.split(key, len(tables)))

    def shoot(carry: tuple, number: Any) -> tuple[tuple, None]:
        state, obs = carry
        actions = jax.lax.map(lambda pair: teacher.best_action(*pair), (state, obs))
        after, step = jax.vmap(env.step)(jax.random.split(jax.random.fold_in(key, number), len(tables)), state, actions)
        goes_on = tables % SHOTS > number

        def put(new: Any, old: Any) -> Any:
            return jnp.where(goes_on.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return (jax.tree.map(put, after, state), put(step.obs, obs)), None

    return jax.lax.scan(shoot, (state, obs), jnp.arange(SHOTS - 1))[0]


@jax.jit
def chosen(teacher: Any, state: Any, obs: Any) -> Any:
    """A teacher's best actions."""
    return jax.lax.map(lambda pair: teacher.best_action(*pair), (state, obs))


@jax.jit
def worths(teacher: SearchTeacher, state: Any) -> Any:
    """Return the expected reward of every direction in every situation."""
    return jax.lax.map(lambda one: expected_values(teacher.rewards(one), teacher.aim_error), state)


def compare(name: str, table: Any, tables: int, aim_error_deg: float) -> dict[str, Any]:
    """Return one world's row."""
    before = BilliardsConfig(table, teacher="local_search", aim_error_deg=aim_error_deg)
    config = SCENARIOS[name].apply(before) if name in SCENARIOS else before
    env, plain = make_environment(config), make_environment(before)
    local = make_teacher(config, env)
    assert isinstance(local, LocalSearchTeacher)
    state, obs = met(env, local, episodes("tuning"), jnp.arange(tables))
    full = SearchTeacher(env, local.aim_error, local.habit, local.directions)
    worth = np.asarray(worths(full, state))
    unaware = make_teacher(dataclasses.replace(before, teacher="learned"), plain)
    row: dict[str, Any] = {"world": name, "situations": tables, "best_expected_reward": float(worth.max(1).mean())}
    best = chosen(full, state, obs)
    for who, choice in {
        "local_search": chosen(local, state, obs),
        "learned, unaware": chosen(unaware, state, obs),
    }.items():
        numbers = np.round(np.asarray(to_angle(choice)) / (2 * np.pi) * full.directions).astype(int) % full.directions
        found = worth[np.arange(tables), numbers]
        row[who] = {
            "of_the_best": float(found.sum() / worth.max(1).sum()),
            "same_within_0.15_deg": float((np.rad2deg(np.asarray(DIRECTIONS.distance(choice, best))) < 0.15).mean()),
        }
    print(json.dumps(row), flush=True)
    return row


def main() -> int:
    """Compare and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", default="regulation", choices=("easy", "regulation"))
    parser.add_argument("--tables", type=int, default=24, help="situations")
    parser.add_argument("--aim-error-deg", type=float, default=0.25)
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    rows = [compare(name, asked.table, asked.tables, asked.aim_error_deg) for name in ("unchanged", *SCENARIOS)]
    if asked.out:
        told = {"table": asked.table, "aim_error_deg": asked.aim_error_deg, **provenance(), "rows": rows}
        asked.out.write_text(json.dumps(told, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
