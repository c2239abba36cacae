"""An agent of the simple robot on the quadruped, unchanged: success there and here, and where the gap comes from.

    python experiments/anymal_navigation.py --write

Every row is the same validation episodes, first ones of each environment. The simple robot is changed into the
quadruped one cause at a time: the sensor's noise, then speed, lag and turn rate fitted to its responses
(experiments/fit_robot.py), then all of these. The quadruped is also given a level scan. "fall" ends an episode too; the
footprint is the same on both. In C MuJoCo the first `--judged` of the same episodes are walked, beside MJX's own
figures for these. With --write every row goes to docs/data/anymal_navigation.json as soon as it is measured; --resume
keeps the rows of the same agent that are there.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from fit_robot import FITTED
from fit_robot import RESULTS as FIT

from cuelearner_envs.anymal.environment import SENSOR_NOISE, LeggedNavigation
from cuelearner_envs.anymal.environment import make_environment as make_legged
from cuelearner_envs.anymal.judged import rollout as judged
from cuelearner_envs.navigation.config import make_environment
from cuelearner_envs.navigation.environment import Navigation
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes, rollout
from cuelearner_jax.policies import Agent
from cuelearner_jax.runs.grid import load
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry

ROOT = Path(__file__).parents[1]
AGENT = ROOT / "docs" / "data" / "navigation_agent"
RESULTS = ROOT / "docs" / "data" / "anymal_navigation.json"
SHOWN = ("success", "collision", "fall", "timeout", "duration")


class LevelScan(LeggedNavigation):
    """The quadruped with a scan that stays level, as the simple robot's does."""

    def ranges(self, state: Any) -> jax.Array:
        """The lidar's distances as the robot perceives them [m]."""
        return self.lidar.read(self.world(state.world), state.pose)


def bodies(simple: Navigation, legged: LeggedNavigation, fitted: dict[str, float]) -> dict[str, Navigation]:
    """The environments to compare."""
    noisy = simple.replace(lidar=simple.lidar.replace(noise=jnp.float32(SENSOR_NOISE)))
    changed = {f"simple, {name} fitted": {name: fitted[name]} for name in FITTED}
    changed["simple, all fitted"] = fitted
    level = LevelScan(**{name: getattr(legged, name) for name in legged.__dataclass_fields__})
    return {
        "simple": simple,
        "simple, sensor noise": noisy,
        **{name: simple.replace(robot=simple.robot.replace(**one)) for name, one in changed.items()},
        "simple, all fitted, sensor noise": noisy.replace(robot=simple.robot.replace(**fitted)),
        "anymal, level scan": level,
        "anymal": legged,
    }


def main() -> int:
    """Evaluate and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=AGENT, help="run folder of the agent")
    parser.add_argument("--styles", nargs="+", default=["clutter", "rooms", "corridor"])
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--judged", type=int, default=50, help="of them also in C MuJoCo")
    parser.add_argument("--only", nargs="+", help="these rows alone, by name")
    parser.add_argument("--write", type=Path, nargs="?", const=RESULTS, help="file (default: %(const)s)")
    parser.add_argument("--resume", action="store_true", help="keep the rows that the file of --write has")
    asked = parser.parse_args()
    try:
        task, config, grid = load(asked.run, registry.find)
        lanes = PolicySource(task, config, grid, asked.run).load()[0]
    except UserError as error:
        parser.error(str(error))
    params = jax.tree.map(lambda leaf: leaf[0], lanes.policies["params"])
    fitted = {name: json.loads(FIT.read_text())["fitted"][name] for name in FITTED}
    about = {"run": asked.run.name, "fitted": fitted}
    came = provenance()  # before the first row changes a file of the repository
    rows: list[dict[str, Any]] = []
    if asked.resume:
        if not asked.write or not asked.write.is_file():
            parser.error("--resume needs the file of an interrupted --write")
        before = json.loads(asked.write.read_text())
        if {name: before.get(name) for name in about} != about:
            parser.error(f"{asked.write} is of another agent or fit: leave out --resume")
        rows = before["rows"]

    functions = config.agent_in(registry.find("navigation").environment(config.task))

    @partial(jax.jit, static_argnames="count")
    def in_jax(env: Any, params: Any, count: int) -> Any:
        return rollout(Agent(params, functions), env, episodes(), count, count * 200)

    def in_c(env: Any, count: int) -> Any:
        return judged(Agent(params, functions), env, episodes(), count, count * 200)

    def tell(style: str, name: str, count: int, measure: Callable[[], dict[str, Any]]) -> None:
        known = {(row["style"], row["robot"], row["episodes"]) for row in rows}
        if (asked.only and name not in asked.only) or (style, name, count) in known:
            return
        found = {metric: float(np.mean(value)) for metric, value in measure().items()}
        rows.append({"style": style, "robot": name, "episodes": count, **found})
        told = "".join(f"{found.get(metric, 0.0):10.3f}" for metric in SHOWN)
        print(f"{style:10}{name:36}{count:6d}{told}", flush=True)
        if asked.write:
            asked.write.write_text(json.dumps({**came, **about, "rows": rows}, indent=1) + "\n")

    print(f"{'style':10}{'robot':36}{'count':>6}" + "".join(f"{metric:>10}" for metric in SHOWN))
    for style in asked.styles:
        world = replace(config.task, style=style)
        simple, legged = make_environment(world, "validation"), make_legged(world, "validation")
        for name, env in bodies(simple, legged, fitted).items():
            tell(style, name, asked.episodes, lambda env=env: in_jax(env, params, asked.episodes))
        tell(style, "anymal, the judged", asked.judged, lambda env=legged: in_jax(env, params, asked.judged))
        tell(style, "anymal, C MuJoCo", asked.judged, lambda env=legged: in_c(env, asked.judged))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
