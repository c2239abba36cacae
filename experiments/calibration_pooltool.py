"""Our simulator calibrated by 250 labels about shots on pooltool's table, whose physics nobody here wrote.

    python experiments/calibration_pooltool.py --out FILE [--seeds 8] [--racks 200] [--processes 2]

Unknown are the friction between balls (throw), how much of its roll a ball keeps through an impact (follow), and how
much speed a cushion leaves. A teacher plays shots in pooltool within a degree of the shipped network's own, says on
which side of a shot asked about the best of them lies, and says nothing where none succeeds: such a question is spent
too. With the estimate, either the network's shots are turned, or all directions are tried in the calibrated simulator.

Beside it: the network as it is, the search in our own table, and unknowns fitted to rewards of thousands of shots on
tuning racks. Every policy plays the same validation racks, ten shots on each. Needs the extra `pooltool`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from adaptation_pooltool import REACH_DEG, TABLE, TRIED, Row, mean, played, table
from jaxtyping import Array

import cuelearner_jax as cl
from cuelearner_envs.billiards.environment import Balls, Billiards
from cuelearner_envs.billiards.table import Cloth
from cuelearner_envs.billiards.teacher import NearbyTeacher, SearchTeacher
from cuelearner_jax import teachers
from cuelearner_jax.agents.choice import best_near_peaks
from cuelearner_jax.calibration import calibrate
from cuelearner_jax.calibration.families import Distortion, Unknown, declared_distortions
from cuelearner_jax.calibration.policy import Calibrated
from cuelearner_jax.calibration.simulator import simulator_distortion
from cuelearner_jax.calibration.walk import Walk
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import actions_of
from cuelearner_jax.policies import Taught, Teaching
from cuelearner_jax.policies.node import PolicyNode
from cuelearner_jax.spaces.directions import evenly_spaced, rotate
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks.billiards import SHIPPED_TEACHERS

LABELS, SHOTS = 250, 10
EPS_DEG = 0.1  # strength of an answer
AIM_DEG = 0.15  # teacher, network's turn and search prefer the middle of what succeeds, for a player who errs by that
DIRECTIONS = 1440  # of the search
COARSE, PEAKS = 450, 8  # of the network's search: directions of a first look, and maxima that are looked at
UNKNOWNS = (Unknown("throw", "1", scale=0.1), Unknown("follow", "1", scale=0.15), Unknown("cushion", "1", scale=0.2))
MOST_FOLLOW, LEAST_REBOUND = 0.45, 0.1
FITTED_RACKS, FITTED_DEG = 20, 3.0  # of the fit to rewards: tuning racks, and shots every tenth of a degree so far
GRID = ((-0.25, -0.2, -0.15, -0.1, 0.0), (0.0, 0.1, 0.2, 2 / 7, 0.4), (-0.6, -0.45, -0.3, -0.15, 0.0))


class Network(PolicyNode):
    """The shipped network of expected rewards, played greedily."""

    network: Any

    def act(self, key: Any, states: Any, obs: Array) -> Array:
        """Return the direction of the largest value."""
        values = self.network.values
        return best_near_peaks(values, values, evenly_spaced(3600), obs, COARSE, PEAKS)


class FrankTeacher(NearbyTeacher):
    """Says nothing where no shot near succeeds (NaN), instead of "already right"."""

    def best_action(self, state: Balls, obs: Array) -> Array:
        """Return the best direction near the proposer's."""
        best = super().best_action(state, obs)
        reward = self.env.step(jax.random.key(0), state, best)[1].reward
        return jnp.where(reward > 0, best, jnp.nan)


def table_of(own: Billiards, theta: Array) -> Billiards:
    """Return our table with a cloth; at zero it plays as it is."""
    cloth = Cloth(
        throw=jnp.maximum(own.table.friction + theta[0], 0.0),
        roll=jnp.clip(theta[1], 0.0, MOST_FOLLOW),
        rebound=jnp.clip(own.table.restitution + theta[2], LEAST_REBOUND, 1.0),
    )
    return own.replace(table=own.table.replace(cloth=cloth))


def family_of(own: Billiards) -> tuple[Distortion, ...]:
    """Return what may have changed: the table, or the strike."""

    def state_of(obs: Array) -> Balls:
        balls = obs.reshape(-1, 3)
        return Balls(balls[:, :2], balls[:, 2] > 0, jnp.zeros((), jnp.int32))

    space = actions_of(own)
    played_on = simulator_distortion(
        "table", UNKNOWNS, lambda theta: table_of(own, theta), state_of, space, REACH_DEG, TRIED, AIM_DEG
    )
    return played_on, declared_distortions(own)[-1]


def planned(own: Billiards, theta: Any) -> Taught:
    """Return the search of all directions in the calibrated simulator."""
    return Taught(SearchTeacher(table_of(own, jnp.asarray(theta)), jnp.deg2rad(AIM_DEG), 0.0, DIRECTIONS))


@jax.jit
def _near(env: Any, states: Any, actions: Array) -> Array:
    """Return rewards (n, shots) of shots near actions (n, 2)."""
    turns = jnp.deg2rad(jnp.linspace(-FITTED_DEG, FITTED_DEG, round(20 * FITTED_DEG) + 1))
    shoot = lambda state, action: env.step(jax.random.key(0), state, action)[1].reward  # noqa: E731
    return jax.vmap(lambda state, action: jax.vmap(lambda turn: shoot(state, rotate(action, turn)))(turns))(
        states, actions
    )


def fitted(base: Any, own: Billiards, env: Any) -> Row:
    """Return the unknowns with which our simulator pays most like pooltool near the network's shots on tuning racks.

    `likeness` is the correlation of rewards: as our table is, with each of the found unknowns alone, and with all.
    """
    split, rows = cl.evaluate.episodes("tuning"), []
    state, obs = jax.vmap(env.reset)(jax.random.split(split, FITTED_RACKS))
    for shot in range(SHOTS):
        key = jax.random.fold_in(split, shot)
        action = base.act(key, state, obs)
        if shot % 2 == 0:
            rows.append((state, action))
        state, step = jax.jit(jax.vmap(env.step))(jax.random.split(key, FITTED_RACKS), state, action)
        obs = step.obs
    states, actions = jax.tree.map(lambda *parts: jnp.concatenate(parts), *rows)
    true = np.asarray(_near(env, states, actions)).ravel()

    def likeness(theta: Sequence[float]) -> float:
        paid = _near(table_of(own, jnp.asarray(theta, jnp.float32)), states, actions)
        return float(np.corrcoef(np.asarray(paid).ravel(), true)[0, 1])

    found = max(product(*GRID), key=likeness)
    alone = {one.name: [value if place == at else 0.0 for place, value in enumerate(found)] for at, one in
             enumerate(UNKNOWNS)}  # fmt: skip
    told = {"none": [0.0] * 3, **alone, "all": list(found)}
    return {"theta": list(found), "likeness": {name: round(likeness(theta), 3) for name, theta in told.items()}}


def calibrated(base: Any, own: Billiards, env: Any, seed: int) -> tuple[Row, Any]:
    """Return what 250 questions tell, and the policy whose shots are turned."""
    teacher = FrankTeacher(Teaching(base), env, jnp.deg2rad(AIM_DEG), jnp.deg2rad(REACH_DEG), TRIED)
    walk, answers = Walk(env, teacher, Scalars(eps_deg=EPS_DEG)), []

    def asked(*question: Any) -> Array:
        answers.append(np.asarray(walk.answers(*question)).ravel())
        return answers[-1][:, None]

    found = calibrate(
        base, family_of(own), walk.situations, asked, LABELS, jax.random.key(seed),
        space=actions_of(own), eps_deg=EPS_DEG,
    )  # fmt: skip
    given = np.concatenate(answers)
    counts = [int((given == answer).sum()) for answer in (-1, 0, 1)]
    estimates = {one.name: [round(value, 4) for value in (one.mean, one.low, one.high)] for one in found.estimates}
    theta = [estimates[one.name][0] if "table" in found.changes else 0.0 for one in UNKNOWNS]
    evidence = {" + ".join(names) or "none": round(value, 1) for names, value in found.evidence.items()}
    told = {"verdict": found.verdict, "changes": found.changes, "estimates": estimates, "evidence": evidence}
    return {**told, "theta": theta, "answers": counts, "silent": int(np.isnan(given).sum())}, found.policy


def measure(seeds: int, racks: int, processes: int) -> Iterator[Row]:
    """Yield all measurements, each as soon as it is made."""
    own: Any = cl.make("billiards", table=TABLE).env
    env: Any = cl.make("billiards", table=TABLE, robot="pooltool").env
    env = env.replace(processes=processes)
    base = Network(teachers.load(SHIPPED_TEACHERS / TABLE, own, 0.0, 0.0))  # pyright: ignore[reportCallIssue]

    def row(what: str, where: Any, policy: Any, seed: int = 0, labels: int = 0, **told: Any) -> Row:
        rewards = np.round(played(where, policy, racks, SHOTS), 4).tolist()
        return {"what": what, "seed": seed, "labels": labels, **told, "rewards": rewards}

    yield row("own table", own, base)
    yield row("not adapted", env, base)
    yield row("search in our table, on it", own, planned(own, [0.0] * 3))
    yield row("search in our table", env, planned(own, [0.0] * 3))
    fit = fitted(base, own, env)
    theta = jnp.asarray(fit["theta"], jnp.float32)
    yield row("fitted to shots, turned", env, Calibrated(base, theta, family_of(own)[:1]), **fit)
    yield row("fitted to shots, search", env, planned(own, theta), **fit)
    for seed in range(seeds):
        began = time.monotonic()
        found, policy = calibrated(base, own, env, seed)
        found["seconds"] = round(time.monotonic() - began)
        yield row("calibrated, turned", env, policy, seed, LABELS, **found)
        yield row("calibrated, search", env, planned(own, found["theta"]), seed, LABELS, **found)


def shares(rows: Sequence[Row]) -> str:
    """Return the share of the loss that each policy wins back, a line each; with the spread over label seeds."""
    means = [(row["what"], float(np.mean(row["rewards"]))) for row in rows]
    own, before = (dict(means).get(name, np.nan) for name in ("own table", "not adapted"))
    lines = []
    for name in dict.fromkeys(name for name, _ in means):
        won = [(value - before) / (own - before) for what, value in means if what == name]
        lines.append(f"{name}: share of the loss {mean(won)} (least {min(won):.2f}, of {len(won)})")
    return "\n".join(lines)


def main() -> None:
    """Measure, write after each measurement, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8, help="of labels")
    parser.add_argument("--racks", type=int, default=200, help="of a measurement")
    parser.add_argument("--processes", type=int, default=0, help="that play in pooltool (0: one for each processor)")
    parser.add_argument("--out", type=Path, required=True, help="JSON file")
    given, rows = parser.parse_args(), []
    about = {**provenance(), "labels": LABELS, "eps_deg": EPS_DEG, "aim_deg": AIM_DEG, "reach_deg": REACH_DEG}
    for row in measure(given.seeds, given.racks, given.processes):
        rows.append(row)
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps({**about, "rows": rows}) + "\n")
        told = {name: value for name, value in row.items() if name not in ("rewards", "evidence")}
        print(f"{mean(row['rewards'])} {json.dumps(told)}", flush=True)
    print(table(rows), shares(rows), sep="\n\n")


if __name__ == "__main__":
    main()
