"""Success of the arm's scripts in MJX, in C MuJoCo and in Gymnasium-Robotics' Fetch, on as many episodes of each.

    python benchmarks/arm_parity.py --episodes 500 --fetch --write

Without a post the script of push is the one that acts in FetchPush. In changed worlds "teacher" is the script that sees
true places, knows the friction and prefers a side; "base" is the script of what is seen. C MuJoCo makes steps of 2 ms
and solves to convergence. Writes benchmarks/results/arm_parity.json with
--write; rows that were not measured anew stay there.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

import cuelearner_jax as cl
from cuelearner_envs.arm import judged, scripts
from cuelearner_jax import evaluate
from cuelearner_jax.evaluate import mean_interval
from cuelearner_jax.policies import Heuristic, Taught
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry

RESULTS = Path(__file__).parent / "results" / "arm_parity.json"
TASK: Any = registry.find("arm")
WORLDS: dict[str, list[tuple[str | None, dict[str, Any]]]] = {
    "reach": [(None, {}), ("turned_camera", {}), (None, {"within": 0.015}), ("hand_eye", {"within": 0.015})],
    "push": [
        (None, {}),
        (None, {"obstacle": False}),
        ("turned_camera", {}),
        ("hand_eye", {}),
        ("slippery", {}),
        ("past_left", {}),
        ("past_right", {}),
    ],
    "pick": [(None, {}), ("turned_camera", {}), ("hand_eye", {}), ("slippery", {})],
}
FETCH = {
    "FetchReach-v4": ("reach", scripts.reach),
    "FetchPush-v4": ("push", lambda obs: scripts.past(obs, post=0.0)),
    "FetchPickAndPlace-v4": ("pick", scripts.pick),
}


def rows_of(skill: str, episodes: int) -> list[dict[str, Any]]:
    """Base and teacher in each world in MJX; the teacher in the unchanged one in C MuJoCo too."""

    @jax.jit
    def played(env: Any, policy: Any) -> dict[str, Any]:
        return evaluate._rolled(policy, env, evaluate.episodes("tuning"), episodes, 50 * episodes).each

    found = []
    for scenario, changes in WORLDS[skill]:
        config = TASK.configure(scenario, skill=skill, **changes)
        env, metric = TASK.environment(config), "success"
        if scenario is not None and TASK.scenario(scenario).judge_by:
            metric = TASK.scenario(scenario).judge_by
        teacher = Taught(TASK.make_teacher(config, env))
        for name, policy in (("base", Heuristic(env)), ("teacher", teacher)):
            found.append(_row(skill, scenario, changes, name, "MJX", metric, played(env, policy)[metric]))
        if scenario is None:
            values = judged.rollout(teacher, env, evaluate.episodes("tuning"), episodes, 50 * episodes)[metric]
            found.append(_row(skill, scenario, changes, "teacher", "C MuJoCo", metric, values))
    return found


def fetch_rows(episodes: int) -> list[dict[str, Any]]:
    """The scripts in Fetch."""
    found = []
    for name, (skill, script) in FETCH.items():
        measured = cl.measure(script, cl.from_gymnasium(name), episodes=episodes)
        rate = float(np.mean(measured.metrics["success"]))
        values = np.repeat([1.0, 0.0], [round(rate * episodes), episodes - round(rate * episodes)])
        found.append(_row(skill, None, {}, "script", name, "success", values))
    return found


def _row(skill: str, scenario: str | None, changes: dict, policy: str, engine: str, metric: str, values: Any) -> dict:
    mean, low, high = mean_interval(np.asarray(values)).tolist()
    told = ", ".join(f"{name} {value}" for name, value in changes.items())
    world = ", ".join(part for part in (scenario or "unchanged", told) if part)
    print(f"{skill:6} {world:32} {policy:8} {engine:22} {metric:13} {mean:.3f} [{low:.3f}, {high:.3f}]", flush=True)
    row = {"skill": skill, "world": world, "policy": policy, "engine": engine, "metric": metric}
    return {**row, "mean": mean, "low": low, "high": high, "episodes": len(np.asarray(values))}


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--skills", nargs="*", default=list(WORLDS), choices=list(WORLDS))
    parser.add_argument("--fetch", action="store_true", help="also in Gymnasium-Robotics' Fetch")
    parser.add_argument("--write", type=Path, nargs="?", const=RESULTS, help="file (default: %(const)s)")
    asked = parser.parse_args()
    rows = [row for skill in asked.skills for row in rows_of(skill, asked.episodes)]
    rows += fetch_rows(asked.episodes) if asked.fetch else []
    if asked.write:
        before = json.loads(asked.write.read_text())["rows"] if asked.write.exists() else []
        kept = [row for row in before if all(_named(row) != _named(new) for new in rows)]
        asked.write.write_text(json.dumps({**provenance(), "rows": [*kept, *rows]}, indent=1) + "\n")


def _named(row: dict[str, Any]) -> tuple[str, ...]:
    return row["skill"], row["world"], row["policy"], row["engine"]


if __name__ == "__main__":
    main()
