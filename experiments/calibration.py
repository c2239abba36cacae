"""What answers tell about a changed world, and what the policy is worth behind it: calibration by 10 to 100 labels.

    python experiments/calibration.py --task billiards --bases RUN
    python experiments/calibration.py --task navigation --bases docs/data/navigation_agent
    python experiments/calibration.py --task billiards

RUN is the folder of a run of the preset `regulation`; each of its seeds is calibrated. Without it, billiards is played
by the shipped network, greedily. No rewarded step is spent; the last table compares the policies on episodes that
nothing was chosen on.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_envs.billiards.environment import Balls
from cuelearner_jax.adaptation.adapting import settling
from cuelearner_jax.agents.choice import best_near_peaks
from cuelearner_jax.calibration.calibrating import Result, calibrate
from cuelearner_jax.calibration.families import Distortion, Unknown, declared
from cuelearner_jax.calibration.simulated import simulated
from cuelearner_jax.calibration.walking import Walk
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import actions_of
from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import policy_of
from cuelearner_jax.runs.trained import PolicySource, several
from cuelearner_jax.spaces.directions import evenly_spaced
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import registry

UNCHANGED = "unchanged"
# A scenario, whose teacher and answers hold, and what else changes; a noisy lidar is no change of the family.
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "turned_strike": ("turned_strike", {}),
    "shifted_balls": ("shifted_balls", {}),
    "turned_and_shifted": ("turned_strike", {"observation_bias": (0.0071, 0.0071)}),
    "tilted_table": ("tilted_table", {}),
    "turned_lidar": ("turned_lidar", {}),
    "noisy_lidar": ("turned_lidar", {"lidar_rotation_deg": 0.0, "lidar_dropout": 0.3}),
}
LIKE = {"billiards": "turned_strike", "navigation": "turned_lidar"}
WORLDS = {
    "billiards": (UNCHANGED, "turned_strike", "shifted_balls", "turned_and_shifted", "tilted_table"),
    "navigation": (UNCHANGED, "turned_lidar", "noisy_lidar"),
}
METRIC = {"billiards": "reward", "navigation": "success"}
LABELS = (10, 25, 50, 100)
ENVS = 200
REACH_DEG = 0.6  # how far a tilt may bend a shot
COARSE, PEAKS = 450, 8  # of the shipped network's search: directions of a first look, and maxima that are looked at


class World(NamedTuple):
    """A changed world."""

    config: Any
    env: Any  # in which is asked
    shown: Any  # in which policies are compared
    scalars: Scalars
    teacher: Any


def world_of(task: Any, name: str, own: Any, scalars: Scalars, split: str, faults: dict[str, float]) -> World:
    """The world of a scene, its teacher, and answers as its scenario has them; `faults`: of the teacher."""
    scenario, more = SCENES.get(name, (LIKE[task.name], {}))
    rules = task.scenario(scenario)
    applied = dataclasses.replace(rules.applied(own), **more)
    config = dataclasses.replace(own, **({"teacher": applied.teacher} if task.name == "billiards" else {}))
    config = config if name == UNCHANGED else applied
    scalars = dataclasses.replace(settling(scalars, rules.eps_deg), **{**rules.scalars, **faults})
    env = task.environment(config)
    return World(config, env, task.environment(config, split), scalars, task.make_teacher(config, env))


def family_of(task: Any, own: Any, world: World, tilt: bool) -> tuple[Distortion, ...]:
    """What may have changed, as the world declares it; `tilt`: and the table, as a simulator has it."""
    if not tilt:
        return declared(world.env)
    known, space = task.environment(own), actions_of(world.env)

    def env_of(theta: Any) -> Any:
        return known.replace(table=known.table.replace(acceleration=theta))

    def state_of(obs: Any) -> Balls:
        balls = obs.reshape(-1, 3)
        return Balls(balls[:, :2], balls[:, 2] > 0, jnp.zeros((), jnp.int32))

    unknowns = (Unknown("tilt x", "m/s^2"), Unknown("tilt y", "m/s^2"))
    return (*declared(world.env), simulated("table: tilt", unknowns, env_of, state_of, space, REACH_DEG))


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
    source = PolicySource.of_run(folder, registry.find)
    assert source.grid is not None
    env = task.environment(source.config.task)
    policies, seeds = several(source, source.config.task, "agent", None, None, source.grid.seeds, env=env)
    return source.config.task, source.config.scalars, dict(zip(map(int, seeds), policies, strict=True))


def worth(world: World, policy: Any, split: str, steps: int) -> float:
    """The task's metric of a policy."""
    name = METRIC["billiards" if hasattr(world.config, "table") else "navigation"]
    return float(evaluate_policy(world.shown, policy, episodes(split), ENVS, steps)[name])


def told(found: Result) -> dict[str, Any]:
    """A result in plain values."""
    estimates = {one.name: [round(number, 5) for number in (one.mean, one.low, one.high)] for one in found.estimates}
    evidence = {" + ".join(names) or "none": round(value, 2) for names, value in found.evidence.items()}
    plain = {"verdict": found.verdict, "changes": found.changes, "estimates": estimates, "evidence": evidence}
    return {**plain, "held_out": found.held_out, "wrong": found.wrong, "apart": found.apart, "more": found.more}


def main() -> None:
    """Calibrates each base in each world with each number of labels; prints a line each, then the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(WORLDS), default="billiards")
    parser.add_argument("--bases", type=Path, help="run folder of the base agents")
    parser.add_argument("--worlds", nargs="+", help="these alone")
    parser.add_argument("--labels", nargs="+", type=int, default=LABELS)
    parser.add_argument("--seeds", type=int, default=1, help="of labels, for each base")
    parser.add_argument("--most-bases", type=int, default=8)
    parser.add_argument("--mistakes", type=float, default=0.0, help="that an answer is reversed; 0.5: a control")
    parser.add_argument("--bias-deg", type=float, default=0.0, help="of everything that the teacher means")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=10_000, help="of an evaluation; 0: none")
    parser.add_argument("--split", choices=("tuning", "validation"), default="tuning", help="of its episodes")
    parser.add_argument("--out", type=Path, help="write all rows to this JSON file")
    asked = parser.parse_args()
    task = registry.find(asked.task)
    own, scalars, bases = bases_of(task, asked.bases)
    faults = {"mistake_probability": asked.mistakes, "teacher_bias_deg": asked.bias_deg}
    rows: list[dict[str, Any]] = []
    for name in asked.worlds or WORLDS[asked.task]:
        world = world_of(task, name, own, scalars, asked.split, faults)
        family, space = family_of(task, own, world, name == "tilted_table"), actions_of(world.env)
        for base, policy in list(bases.items())[: asked.most_bases]:
            if asked.steps:
                rows.append(
                    {"world": name, "base": base, "labels": 0, "worth": worth(world, policy, asked.split, asked.steps)}
                )
                print(rows[-1], flush=True)
            for labels in asked.labels:
                for seed in range(asked.first_seed, asked.first_seed + asked.seeds):
                    start, used, walk = time.time(), time.process_time(), Walk(world.env, world.teacher, world.scalars)
                    key = jax.random.fold_in(jax.random.key(seed), labels)
                    found = calibrate(
                        policy, family, walk.situations, walk.answers, labels, key,
                        space=space, eps_deg=world.scalars.eps_deg,
                    )  # fmt: skip
                    row = {"world": name, "base": base, "labels": labels, "seed": seed, **told(found)}
                    row["seconds"], row["cpu_seconds"] = (
                        round(now - then, 1) for now, then in ((time.time(), start), (time.process_time(), used))
                    )
                    if asked.steps:
                        row["worth"] = worth(world, found.policy, asked.split, asked.steps)
                    rows.append(row)
                    print(json.dumps(row), flush=True)
    if asked.out:
        asked.out.write_text(json.dumps({**provenance(), "task": asked.task, "rows": rows}, indent=1) + "\n")
    table(rows)


def table(rows: list[dict[str, Any]]) -> None:
    """Prints the mean worth, and how often each verdict was found, by world and number of labels."""
    for world, labels in dict.fromkeys((row["world"], row["labels"]) for row in rows):
        own = [row for row in rows if (row["world"], row["labels"]) == (world, labels)]
        worths = [row["worth"] for row in own if "worth" in row]
        shown = f"{np.mean(worths):.3f} (least {np.min(worths):.3f})" if worths else "-"
        found = [" + ".join(row["changes"]) or row["verdict"] for row in own if "verdict" in row]
        counts = ", ".join(f"{found.count(one)} x {one}" for one in dict.fromkeys(found))
        print(f"{world:<16}{labels:>4} labels  {shown}  {counts}")


if __name__ == "__main__":
    main()
