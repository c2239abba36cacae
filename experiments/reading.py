"""Readings of 10 to 100 labels about changed worlds of billiards and navigation, and the policy's gain.

    python experiments/reading.py --task billiards --bases RUN
    python experiments/reading.py --task navigation --bases docs/data/navigation_agent
    python experiments/reading.py --task billiards

RUN is the folder of a run of the preset `regulation`; each of its seeds is corrected. Without it, billiards is played
by the shipped network, greedily. No rewarded step is spent; the table compares the policies on episodes that nothing
was chosen on.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cuelearner_jax.adaptation.by_model import settling
from cuelearner_jax.adaptation.by_reading import ask_in_batches
from cuelearner_jax.agents.choice import best_near_peaks
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import actions_of
from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import policy_of
from cuelearner_jax.reading import Distortion, Reading, Walk, declared_distortions
from cuelearner_jax.report.statistics import resampled
from cuelearner_jax.runs.policy_sources import LaneChoice, PolicySource
from cuelearner_jax.spaces.directions import evenly_spaced
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry

UNCHANGED = "unchanged"
# A scenario, whose teacher and answers hold, and what else changes; a noisy lidar is no change of the family.
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "turned_strike": ("turned_strike", {}),
    "shifted_balls": ("shifted_balls", {}),
    "turned_and_shifted": ("turned_strike", {"observation_bias": (0.0071, 0.0071)}),
    "turned_lidar": ("turned_lidar", {}),
    "turned_sensors": ("turned_lidar", {"goal_rotation_deg": 10.0}),
    "noisy_lidar": ("turned_lidar", {"lidar_rotation_deg": 0.0, "lidar_dropout": 0.3}),
}
LIKE = {"billiards": "turned_strike", "navigation": "turned_lidar"}
WORLDS = {
    "billiards": (UNCHANGED, "turned_strike", "shifted_balls", "turned_and_shifted"),
    "navigation": (UNCHANGED, "turned_lidar", "turned_sensors", "noisy_lidar"),
}
METRIC = {"billiards": "reward", "navigation": "success"}
LABELS = (10, 25, 50, 100)
ENVS = 200
COARSE, PEAKS = 450, 8  # of the shipped network's search: directions of a first look, and maxima that are looked at


class World(NamedTuple):
    """A changed world."""

    config: Any
    env: Any  # in which is asked
    shown: Any  # in which policies are compared
    scalars: Scalars
    teacher: Any


def world_of(task: Any, name: str, own: Any, scalars: Scalars, split: str) -> World:
    """The world of a scene, its teacher, and answers as its scenario has them."""
    scenario, more = SCENES.get(name, (LIKE[task.name], {}))
    rules = task.scenario(scenario)
    applied = dataclasses.replace(rules.apply(own), **more)
    config = dataclasses.replace(own, **({"teacher": applied.teacher} if task.name == "billiards" else {}))
    config = config if name == UNCHANGED else applied
    scalars = dataclasses.replace(settling(scalars, rules.eps_deg), **rules.scalars)
    env = task.environment(config)
    return World(config, env, task.environment(config, split), scalars, task.make_teacher(config, env))


def bases_of(task: Any, folder: Path | None) -> tuple[Any, Scalars, dict[int, Any]]:
    """The task's configuration, the scalars and the base policies by their seeds."""
    if folder is None:
        if task.name != "billiards":
            raise SystemExit("give --bases a run folder of navigation")
        own = task.config(teacher="learned")
        network = task.make_teacher(own, task.environment(own))
        values, shots = network.teacher.values, evenly_spaced(network.teacher.directions)
        greedy = lambda obs: best_near_peaks(values, values, shots, obs, COARSE, PEAKS)  # noqa: E731
        return own, Scalars(), {0: policy_of(jax.jit(greedy))}
    source = PolicySource.of_folder(folder, registry.find)
    assert source.grid is not None
    env = task.environment(source.config.task)
    policies, _ = LaneChoice(seed=source.grid.seeds).lanes_in(source, source.config.task, env)
    return source.config.task, source.config.scalars, dict(zip(source.grid.seeds, policies, strict=True))


def worth(world: World, policy: Any, split: str, steps: int) -> float:
    """The task's metric of a policy."""
    name = METRIC["billiards" if hasattr(world.config, "table") else "navigation"]
    return float(evaluate_policy(world.shown, policy, episodes(split), ENVS, steps)[name])


class Study(NamedTuple):
    """Base policies, worlds and answers of one study."""

    task: Any
    own: Any  # the configuration of the unchanged world
    scalars: Scalars
    bases: dict[int, Any]
    asked: argparse.Namespace
    made: dict[str, tuple[World, tuple[Distortion, ...]]]  # worlds so far: what is compiled for one serves again

    def world(self, name: str) -> tuple[World, tuple[Distortion, ...]]:
        """A world and what may have changed in it."""
        if name in self.made:
            return self.made[name]
        world = world_of(self.task, name, self.own, self.scalars, self.asked.split)
        self.made[name] = world, declared_distortions(world.env)
        return self.made[name]

    def row(self, name: str, base: int, seed: int, labels: int) -> dict[str, Any]:
        """Return what so many answers tell of a world, and what the corrected policy earns there."""
        world, family = self.world(name)
        start, walk = time.time(), Walk(world.env, world.teacher, world.scalars)
        policy, eps = self.bases[base], float(world.scalars.eps_deg)
        reading = Reading(policy, family, actions_of(world.env), eps, labels, world.env.observation)
        ask_in_batches(reading, walk, seed * 1000 + labels, labels)
        found = reading.result()
        seconds, better = round(time.time() - start, 1), found.policy if found.used else policy
        estimates = {
            one.name: [round(number, 5) for number in (one.mean, one.low, one.high)] for one in found.estimates
        }
        return {
            "world": name, "base": base, "labels": labels, "seed": seed, "eps_deg": eps, "seconds": seconds,
            "used": found.used, "evidence": round(found.evidence, 2), "estimates": estimates,
            "depends": found.depends, "wrong": round(found.wrong, 3),
            "corrected": worth(world, found.policy, self.asked.split, self.asked.steps),
            "worth": worth(world, better, self.asked.split, self.asked.steps),
        }  # fmt: skip

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield a row for each world and base as it is, then for each seed and number of labels."""
        for name in self.asked.worlds or WORLDS[self.task.name]:
            for base in self.bases:
                earned = worth(self.world(name)[0], self.bases[base], self.asked.split, self.asked.steps)
                yield {"world": name, "base": base, "labels": 0, "worth": earned}
            for base, seed in product(self.bases, range(self.asked.seeds)):
                yield from (self.row(name, base, seed, labels) for labels in self.asked.labels)


def arguments() -> argparse.ArgumentParser:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(WORLDS), default="billiards")
    parser.add_argument("--bases", type=Path, help="run folder of the base agents")
    parser.add_argument("--worlds", nargs="+", help="these alone")
    parser.add_argument("--labels", nargs="+", type=int, default=LABELS)
    parser.add_argument("--seeds", type=int, default=1, help="of labels, for each base")
    parser.add_argument("--steps", type=int, default=10_000, help="of an evaluation")
    parser.add_argument("--split", choices=("tuning", "validation"), default="tuning", help="of its episodes")
    parser.add_argument("--out", type=Path, help="write all rows to this JSON file")
    return parser


def main() -> None:
    """Correct each base in each world with each number of labels; prints a line each, then the table."""
    options = arguments().parse_args()
    task = registry.find(options.task)
    own, scalars, bases = bases_of(task, options.bases)
    study = Study(task, own, scalars, bases, options, {})
    rows: list[dict[str, Any]] = []
    for row in study.rows():
        rows.append(row)
        print(json.dumps(row), flush=True)
        if options.out:
            options.out.write_text(json.dumps({**provenance(), "task": options.task, "rows": rows}, indent=1) + "\n")
    table(rows)


def mean_worth(rows: list[dict[str, Any]]) -> str:
    """Return the mean worth with its 95% bootstrap interval over bases and their label seeds, and the least worth."""
    bases = dict.fromkeys(row["base"] for row in rows)
    values = np.array([[row["worth"] for row in rows if row["base"] == base] for base in bases])
    low, high = np.quantile(resampled(values, mean=np.mean), (0.025, 0.975))
    shown = f"{values.mean():.3f}" + (f" [{low:.3f}, {high:.3f}]" if values.size > 1 else "")
    return f"{shown} (least {values.min():.3f})"


def table(rows: list[dict[str, Any]]) -> None:
    """Print the mean worth and how many corrections are used, by world and number of labels."""
    for world, labels in dict.fromkeys((row["world"], row["labels"]) for row in rows):
        own = [row for row in rows if (row["world"], row["labels"]) == (world, labels)]
        used = sum(row.get("used", False) for row in own)
        print(f"{world:<20}{labels:>4} labels  {mean_worth(own)}  {used} of {len(own)} used")


if __name__ == "__main__":
    main()
