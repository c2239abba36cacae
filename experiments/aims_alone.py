"""Measure the aims of the billiards tables without any label.

    python experiments/aims_alone.py --out docs/data/aims_alone.json

A guide of the kind `intent` chooses among the aims that a table offers (each target straight into each pocket). How
much of what it earns is the geometry's, and how much the labels'? Reward a shot of an aim taken at random among those
that are possible, in reported episodes, beside the closest ball and chance. A minute on two cores.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_jax.evaluate import SPLITS, episodes, evaluate_policy
from cuelearner_jax.policies import Heuristic, PolicyNode, Uniform
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage.provenance import provenance

TABLES = ("easy", "regulation")


class AimAtRandom(PolicyNode):
    """Policy that chooses a possible aim uniformly; any direction where there is no aim."""

    env: Any

    def act(self, key: PRNGKeyArray, states: Any, obs: Float[Array, "n obs"]) -> Float[Array, "n 2"]:
        """An aim for each situation."""

        def one(key: PRNGKeyArray, obs: Array) -> Array:
            k_aim, k_any = jax.random.split(key)
            aims = self.env.aims(obs)
            chosen = jax.random.categorical(k_aim, jnp.where(aims.possible, 0.0, -jnp.inf))
            return jnp.where(aims.possible.any(), aims.actions[chosen], DIRECTIONS.sample(k_any, ()))

        return jax.vmap(one)(jax.random.split(key, obs.shape[0]), obs)


def main() -> None:
    """Measure both tables, prints them, writes JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000, help="shots of an evaluation")
    parser.add_argument("--split", choices=list(SPLITS), default="validation", help="episodes of the evaluation")
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    asked = parser.parse_args()
    rows = []
    for table in TABLES:
        env = make_environment(BilliardsConfig(table))
        policies = {"uniform": Uniform(), "heuristic": Heuristic(env), "aim_at_random": AimAtRandom(env)}
        key = episodes(asked.split)
        found = {n: float(evaluate_policy(env, p, key, 100, asked.steps)["reward"]) for n, p in policies.items()}
        rows.append({"table": table, **found})
        print(f"{table:<10}  " + "  ".join(f"{name} {value:.3f}" for name, value in found.items()), flush=True)
    if asked.out:
        told = {**provenance(), "split": asked.split, "steps": asked.steps, "rows": rows}
        asked.out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
