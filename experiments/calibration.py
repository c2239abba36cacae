"""Calibration by 10 to 100 labels: what answers tell about a changed world, and the policy's gain.

    python experiments/calibration.py --task billiards --bases RUN
    python experiments/calibration.py --task navigation --bases docs/data/navigation_agent
    python experiments/calibration.py --task billiards

RUN is the folder of a run of the preset `regulation`; each of its seeds is calibrated. Without it, billiards is played
by the shipped network, greedily. No rewarded step is spent; the last table compares the policies on episodes that
nothing was chosen on. Many processes may share the work, and another may compare the policies later:

    python experiments/calibration.py --task billiards --bases RUN --seeds 4 --shard 3 32 --steps 0 --out 3.json
    python experiments/calibration.py --task billiards --bases RUN --found 1.json 2.json 3.json --out all.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_envs.billiards.environment import Balls
from cuelearner_jax.adaptation.by_model import settling
from cuelearner_jax.agents.choice import best_near_peaks
from cuelearner_jax.calibration import Result, calibrate, read_answers
from cuelearner_jax.calibration.families import Distortion, Unknown, declared_distortions
from cuelearner_jax.calibration.policy import Calibrated
from cuelearner_jax.calibration.simulator import simulator_distortion
from cuelearner_jax.calibration.walk import Walk
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import actions_of
from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import policy_of
from cuelearner_jax.report.statistics import drawn
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
    "turned_sensors": ("turned_lidar", {"goal_rotation_deg": 10.0}),
    "noisy_lidar": ("turned_lidar", {"lidar_rotation_deg": 0.0, "lidar_dropout": 0.3}),
}
LIKE = {"billiards": "turned_strike", "navigation": "turned_lidar"}
WORLDS = {
    "billiards": (UNCHANGED, "turned_strike", "shifted_balls", "turned_and_shifted", "tilted_table"),
    "navigation": (UNCHANGED, "turned_lidar", "turned_sensors", "noisy_lidar"),
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
    applied = dataclasses.replace(rules.apply(own), **more)
    config = dataclasses.replace(own, **({"teacher": applied.teacher} if task.name == "billiards" else {}))
    config = config if name == UNCHANGED else applied
    scalars = dataclasses.replace(settling(scalars, rules.eps_deg), **{**rules.scalars, **faults})
    env = task.environment(config)
    return World(config, env, task.environment(config, split), scalars, task.make_teacher(config, env))


def family_of(task: Any, own: Any, world: World, tilt: bool) -> tuple[Distortion, ...]:
    """Return what may have changed, as the world declares; with `tilt` also the table, by a simulator."""
    if not tilt:
        return declared_distortions(world.env)
    known, space = task.environment(own), actions_of(world.env)

    def env_of(theta: Any) -> Any:
        return known.replace(table=known.table.replace(acceleration=theta))

    def state_of(obs: Any) -> Balls:
        balls = obs.reshape(-1, 3)
        return Balls(balls[:, :2], balls[:, 2] > 0, jnp.zeros((), jnp.int32))

    unknowns = (Unknown("tilt x", "m/s^2"), Unknown("tilt y", "m/s^2"))
    return (
        *declared_distortions(world.env),
        simulator_distortion("table: tilt", unknowns, env_of, state_of, space, REACH_DEG),
    )


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


def to_row(found: Result) -> dict[str, Any]:
    """A result in plain values; `theta`: the unknowns behind which the policy acts."""
    estimates = {one.name: [round(number, 5) for number in (one.mean, one.low, one.high)] for one in found.estimates}
    evidence = {" + ".join(names) or "none": round(value, 2) for names, value in found.evidence.items()}
    plain = {"verdict": found.verdict, "changes": found.changes, "estimates": estimates, "evidence": evidence}
    if isinstance(found.policy, Calibrated):
        plain |= {"theta": np.asarray(found.policy.theta, float).tolist()}
        plain |= {"family": [one.name for one in found.policy.family]}
    numbers = {name: getattr(found, name) for name in ("held_out", "confirmed", "refused", "wrong", "apart", "more")}
    return plain | numbers


def found_policy(row: dict[str, Any], base: Any, family: tuple[Distortion, ...]) -> Any:
    """The policy that a row tells of: the base, or the base behind what was found."""
    if "theta" not in row:
        return base
    own = tuple(one for name in row["family"] for one in family if one.name == name)
    return Calibrated(base, jnp.asarray(row["theta"], jnp.float32), own)


def ready_made(walk: Walk, base: Any, key: Any, labels: int, space: Any, most_deg: float) -> tuple[Any, Any, Any]:
    """Situations, actions turned at random from the base's by at most so much, and answers: as a file holds them."""
    k_where, k_turn, k_act, k_answer = jax.random.split(key, 4)
    states, obs = walk.situations(k_where, base, labels)
    most = space.from_unit(most_deg)
    turns = jax.random.uniform(k_turn, (labels, len(space.cues)), minval=-most, maxval=most)
    actions = jax.vmap(space.exp)(base.act(k_act, states, obs), turns)
    return obs, actions, walk.answers(k_answer, states, obs, actions)


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
        faults: dict[str, Any] = {
            "mistake_probability": self.asked.mistakes,
            "teacher_bias_deg": self.asked.bias_deg,
        }
        if self.asked.eps_deg:
            faults["eps_deg"] = self.asked.eps_deg
        world = world_of(self.task, name, self.own, self.scalars, self.asked.split, faults)
        self.made[name] = world, family_of(self.task, self.own, world, name == "tilted_table")
        return self.made[name]

    def calibrated(self, name: str, base: int, seed: int, labels: int) -> dict[str, Any]:
        """A row: what so many answers tell of a world."""
        world, family = self.world(name)
        start, used, walk = time.time(), time.process_time(), Walk(world.env, world.teacher, world.scalars)
        key = jax.random.fold_in(jax.random.key(seed), labels)
        space, how = actions_of(world.env), {"eps_deg": float(world.scalars.eps_deg)}
        if self.asked.ready_made_deg:
            told = ready_made(walk, self.bases[base], key, labels, space, self.asked.ready_made_deg)
            found = read_answers(self.bases[base], family, *told, space=space, seed=seed, **how)
        else:
            situations, answers = walk.situations, walk.answers
            found = calibrate(self.bases[base], family, situations, answers, labels, key, space=space, **how)
        row = {"world": name, "base": base, "labels": labels, "seed": seed, **to_row(found)}
        row["eps_deg"] = float(world.scalars.eps_deg)
        row["seconds"] = round(time.time() - start, 1)
        return {**row, "cpu_seconds": round(time.process_time() - used, 1)}

    def rows(self) -> Iterator[dict[str, Any]]:
        """A row for each world, base, seed and number of labels of this process's share."""
        number, of = self.asked.shard
        seeds = range(self.asked.first_seed, self.asked.first_seed + self.asked.seeds)
        each = list(product(self.bases, seeds))[number - 1 :: of]
        for name in self.worlds:
            for base, seed in each:
                yield from (self.calibrated(name, base, seed, labels) for labels in self.asked.labels)

    @property
    def worlds(self) -> Sequence[str]:
        """Return the worlds that the command line asks for."""
        return self.asked.worlds or WORLDS[self.task.name]

    def compared(self, rows: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
        """The rows with the worth of their policies, and of the bases as they are."""
        for name in dict.fromkeys(row["world"] for row in rows):
            world, family = self.world(name)
            own = [row for row in rows if row["world"] == name]
            plain = [{"world": name, "base": base, "labels": 0} for base in dict.fromkeys(row["base"] for row in own)]
            unadapted = {}
            for row in [*plain, *own]:
                base = row["base"]
                if row["labels"] and "theta" not in row:
                    yield {**row, "worth": unadapted[base]}  # the policy as it was
                    continue
                policy = found_policy(row, self.bases[base], family)
                earned = worth(world, policy, self.asked.split, self.asked.steps)
                unadapted.setdefault(base, earned)
                yield {**row, "worth": earned}


def arguments() -> argparse.ArgumentParser:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(WORLDS), default="billiards")
    parser.add_argument("--bases", type=Path, help="run folder of the base agents")
    parser.add_argument("--worlds", nargs="+", help="these alone")
    parser.add_argument("--labels", nargs="+", type=int, default=LABELS)
    parser.add_argument("--seeds", type=int, default=1, help="of labels, for each base")
    parser.add_argument("--most-bases", type=int, default=8)
    parser.add_argument("--eps-deg", type=float, default=0.0, help="strength of an answer (default: the scenario's)")
    parser.add_argument("--mistakes", type=float, default=0.0, help="that an answer is reversed; 0.5: a control")
    parser.add_argument("--bias-deg", type=float, default=0.0, help="of everything that the teacher means")
    parser.add_argument("--ready-made-deg", type=float, default=0.0, help="questions turned by as much, as in a file")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--shard", type=int, nargs=2, default=(1, 1), metavar=("K", "N"), help="the K-th of N shares")
    parser.add_argument("--steps", type=int, default=10_000, help="of an evaluation; 0: none")
    parser.add_argument("--split", choices=("tuning", "validation"), default="tuning", help="of its episodes")
    parser.add_argument("--found", type=Path, nargs="+", default=[], help="compare the policies of these files")
    parser.add_argument("--out", type=Path, help="write all rows to this JSON file")
    return parser


def main() -> None:
    """Calibrate each base in each world with each number of labels; prints a line each, then the table."""
    parser = arguments()
    asked = parser.parse_args()
    number, of = asked.shard
    if not 1 <= number <= of:
        parser.error(f"--shard {number} {of}: give the number of a share, from 1 on, and how many there are")
    if missing := [file for file in asked.found if not file.is_file()]:
        parser.error(f"--found {missing[0]}: there is no such file")
    task = registry.find(asked.task)
    own, scalars, bases = bases_of(task, asked.bases)
    study = Study(task, own, scalars, dict(list(bases.items())[: asked.most_bases]), asked, {})
    found = [
        row for file in asked.found for row in json.loads(file.read_text())["rows"] if row["world"] in study.worlds
    ]
    rows: list[dict[str, Any]] = []
    calibrated = found if asked.found else study.rows()
    for row in study.compared(list(calibrated)) if asked.steps else calibrated:
        rows.append(row)
        print(json.dumps(row), flush=True)
        if asked.out:
            asked.out.write_text(json.dumps({**provenance(), "task": asked.task, "rows": rows}, indent=1) + "\n")
    table(rows)


def mean_worth(rows: list[dict[str, Any]]) -> str:
    """Return the mean worth with its 95% bootstrap interval over bases and their label seeds, and the least worth."""
    groups = [
        [row["worth"] for row in rows if row["base"] == base] for base in dict.fromkeys(row["base"] for row in rows)
    ]
    values = np.full((len(groups), max(map(len, groups))), np.nan)  # NaN: not played
    for own, group in zip(values, groups, strict=True):
        own[: len(group)] = group
    means = np.nanmean(values[drawn(*values.shape)], (1, 2))
    low, high = np.quantile(means[1:], (0.025, 0.975))
    shown = f"{means[0]:.3f}" + (f" [{low:.3f}, {high:.3f}]" if values.size > 1 else "")
    return f"{shown} (least {np.nanmin(values):.3f})"


def table(rows: list[dict[str, Any]]) -> None:
    """Print the mean worth, and how often each verdict was found, by world and number of labels."""
    for world, labels in dict.fromkeys((row["world"], row["labels"]) for row in rows):
        own = [row for row in rows if (row["world"], row["labels"]) == (world, labels)]
        played = [row for row in own if "worth" in row]
        shown = mean_worth(played) if played else "-"
        found = [" + ".join(row["changes"]) or row["verdict"] for row in own if "verdict" in row]
        counts = ", ".join(f"{found.count(one)} x {one}" for one in dict.fromkeys(found))
        print(f"{world:<16}{labels:>4} labels  {shown}  {counts}")


if __name__ == "__main__":
    main()
