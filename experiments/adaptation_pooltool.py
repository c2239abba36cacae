"""A policy of our billiards table on pooltool's: cloth, spin and cushions that nobody here wrote, corrected by labels.

    python experiments/adaptation_pooltool.py --out FOLDER [--policy RUN] [--processes 2] [--resume]

The policy (default: the shipped network that expects rewards, as an agent) acts on pooltool's table unchanged, and is
adapted there by `cl.adapt`: the teacher plays shots near what the policy does, and says whether the better ones lie to
the left or to the right. Fewer labels are the first of the most, fitted anew. Every policy plays the
same fresh racks, ten shots on each; the interval is over racks. Needs the extra `pooltool`. At the scale `paper` it
takes a quarter of an hour on 2 free cores, mostly shots in pooltool, one of which takes 10 ms of a core; `smoke` two
minutes. FOLDER/pooltool.json grows with each measurement.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

import cuelearner_jax as cl
from cuelearner_envs.billiards.teacher import NearbyTeacher
from cuelearner_jax import teachers
from cuelearner_jax.agents import ddqn
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.feedback.answers import relative_feedback
from cuelearner_jax.policies import Agent, Taught, Teaching, best_actions
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks.billiards import SHIPPED_TEACHERS

TABLE = "regulation"
# Chosen on tuning racks. Labels are about the policy's own shots, which one pass turns by up to the strength of a
# label: some hundred of them teach on which side it misses in which situations, not where the perfect shot lies to a
# tenth of a degree. Refined in small passes, and asked about refined shots, it gained less.
EPS_DEG = BOUND_DEG = 0.3
SCALARS = Scalars(eps_deg=EPS_DEG, tau_deg=EPS_DEG / 20, k_max=1, refined_fraction=0.0)
SIZES = GuideSizes(frame="action", feedback_layers=(128, 128), fit_steps=400, fit_batch_size=64)
REACH_DEG, TRIED = 1.0, 21  # of the teacher: shots for an answer, every tenth of a degree on either side
AIM_DEG = 0.1  # it prefers the middle of what succeeds, for a player who errs by that
Row = dict[str, Any]


class Scale(NamedTuple):
    """How much is played."""

    racks: int  # of a measurement
    taught: int  # racks on which the teacher itself plays
    shots: int  # on each
    labels: tuple[int, ...]  # budgets, the largest last
    seeds: tuple[int, ...]  # of labels and fits
    judged: int  # tuning episodes, of 100 shots, by which a model is judged
    sizes: GuideSizes


SCALES = {
    "smoke": Scale(2, 1, 2, (10, 20), (0,), 1, GuideSizes("action", (16,), fit_steps=20, fit_batch_size=5)),
    "paper": Scale(200, 40, 10, (250, 500), (0, 1), 5, SIZES),
}


def shipped() -> Agent:
    """The shipped teacher's network as an agent: every direction's expected reward, and the largest is taken."""
    own = cl.make("billiards", table=TABLE).env
    network = teachers.load(SHIPPED_TEACHERS / TABLE, own, 0.0, 0.0)
    functions = ddqn.Config(q_layers=network.layers).make("action", spaces_of(own))
    return Agent(network.params, functions, own)


@partial(jax.jit, static_argnames="racks")
def _racked(env: Any, key: Any, racks: int) -> tuple[Any, Any]:
    return jax.vmap(env.reset)(jax.random.split(key, racks))


@jax.jit
def _shot(env: Any, policy: Any, key: Any, state: Any, obs: Any) -> tuple[Any, Any, Any]:
    k_act, k_env = jax.random.split(key)
    action = policy.act(k_act, state, obs)
    state, step = jax.vmap(env.step)(jax.random.split(k_env, obs.shape[0]), state, action)
    return state, step.obs, step.reward


def played(env: Any, policy: Any, racks: int, shots: int, split: str = "validation") -> np.ndarray:
    """Reward a shot (racks,) of a policy on fresh racks, the same whoever plays."""
    k_rack, k_play = jax.random.split(episodes(split))
    state, obs = _racked(env, k_rack, racks)
    rewards = []
    for shot in range(shots):
        state, obs, reward = _shot(env, policy, jax.random.fold_in(k_play, shot), state, obs)
        rewards.append(np.asarray(reward))
    return np.mean(rewards, axis=0)


def nearby_teacher(base: Any, env: Any) -> NearbyTeacher:
    """Return the teacher, which plays shots near the base policy's."""
    return NearbyTeacher(Teaching(base), env, jnp.deg2rad(AIM_DEG), jnp.deg2rad(REACH_DEG), TRIED)


def ask(base: Any, env: Any, scale: Scale, seed: int) -> cl.Labels:
    """Labels about the base policy's own shots, ten on each of as many racks as it takes, in random order.

    One pass of refinement asks about nothing else, so all racks are played at once.
    """
    count = scale.labels[-1]
    k_rack, k_play, k_order = jax.random.split(jax.random.key(seed), 3)
    state, obs = _racked(env, k_rack, -(-count // scale.shots))
    rows = []
    for shot in range(scale.shots):
        key = jax.random.fold_in(k_play, shot)
        action, answer = _answered(base, nearby_teacher(base, env), key, state, obs)
        rows.append((obs, action, answer))
        state, obs, _ = _shot(env, base, key, state, obs)
    columns = (np.concatenate([np.asarray(row[part]) for row in rows]) for part in range(3))
    order = np.asarray(jax.random.permutation(k_order, count))
    return cl.Labels(*(column[order] for column in columns))


@jax.jit
def _answered(base: Any, teacher: NearbyTeacher, key: Any, state: Any, obs: Any) -> tuple[Any, Any]:
    action = base.act(key, state, obs)
    return action, relative_feedback(DIRECTIONS, action, best_actions(teacher, state, obs), jnp.deg2rad(EPS_DEG))


def adapt(base: Any, env: Any, scale: Scale, seed: int) -> Iterator[tuple[int, cl.AdaptedPolicy]]:
    """The policy after the largest number of labels, then after the first ones of these."""
    labels = ask(base, env, scale, seed)
    for budget in scale.labels[::-1]:
        yield (
            budget,
            cl.adapt(
                base,
                env,
                labels=cl.Labels(*(column[:budget] for column in labels)),
                bound_deg=BOUND_DEG,
                sizes=scale.sizes,
                scalars=SCALARS,
                seed=seed,
                judge_episodes=scale.judged,
            ),
        )


def measure(base: Any, scale: Scale, processes: int, known: Sequence[Row]) -> Iterator[Row]:
    """Yield all measurements but the known ones, each as soon as it is made."""
    own, world = cl.make("billiards", table=TABLE), cl.make("billiards", table=TABLE, robot="pooltool")
    env = world.env.replace(processes=processes)  # pyright: ignore[reportAttributeAccessIssue]
    done = {(row["what"], row["seed"], row["labels"]) for row in known}
    plain = [
        ("own table", own.env, base, scale.racks),
        ("not adapted", env, base, scale.racks),
        ("teacher", env, Taught(nearby_teacher(base, env)), scale.taught),
    ]
    for what, where, policy, racks in plain:
        if (what, 0, 0) not in done:
            yield {"what": what, "seed": 0, "labels": 0, "rewards": played(where, policy, racks, scale.shots)}
    for seed in scale.seeds:
        if all(("adapted", seed, budget) in done for budget in scale.labels):
            continue
        for budget, policy in adapt(base, env, scale, seed):
            answers = np.bincount(np.asarray(policy.labels.answer, int).ravel() + 1, minlength=3).tolist()
            told = {"used": policy.used, "judged": list(policy.judged[1:]), "answers": answers}
            if ("adapted", seed, budget) not in done:
                rewards = played(env, policy.policy, scale.racks, scale.shots)
                yield {"what": "adapted", "seed": seed, "labels": budget, **told, "rewards": rewards}


def mean(values: Any) -> str:
    """A mean over racks with its 95% bootstrap interval."""
    values = np.asarray(values, float)
    if len(values) < 2 or np.ptp(values) < 1e-9:
        return f"{values.mean():.3f}"
    found = scipy.stats.bootstrap((values,), np.mean, n_resamples=2_000, rng=np.random.default_rng(0))
    return f"{values.mean():.3f} [{found.confidence_interval.low:.3f}, {found.confidence_interval.high:.3f}]"


def table(rows: Sequence[Row]) -> str:
    """Print the measurements, seeds together; gains are paired by rack."""
    kinds = dict.fromkeys((row["what"], row["labels"]) for row in sorted(rows, key=lambda row: row["labels"]))
    rewards = {
        kind: np.mean([row["rewards"] for row in rows if (row["what"], row["labels"]) == kind], axis=0)
        for kind in kinds
    }
    before = rewards.get(("not adapted", 0))
    lines = ["| policy | labels | reward a shot | gain |", "|---|---|---|---|"]
    for (what, labels), own in rewards.items():
        gain = "" if before is None or what in ("own table", "not adapted") else mean(own - before[: len(own)])
        lines.append(f"| {what} | {labels or ''} | {mean(own)} | {gain} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, writes after each measurement, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, help="run folder or policy folder (default: the shipped network)")
    parser.add_argument("--scale", choices=list(SCALES), default="paper")
    parser.add_argument("--processes", type=int, default=0, help="that play in pooltool (0: one for each processor)")
    parser.add_argument("--out", type=Path, default=Path("runs/adaptation_pooltool"), help="folder")
    parser.add_argument("--resume", action="store_true", help="keep what FOLDER/pooltool.json has")
    given = parser.parse_args(arguments)
    if given.processes < 0:
        parser.error(f"--processes is {given.processes}: give 0 or more")
    file, rows = given.out / "pooltool.json", []
    about = {"scale": given.scale, "policy": given.policy.name if given.policy else "shipped network"}
    if file.exists():
        found = json.loads(file.read_text())
        if not given.resume or {name: found[name] for name in about} != about:
            parser.error(f"{file} exists, of {found['policy']} at the scale {found['scale']}: give another --out")
        rows = found["rows"]
    try:
        base = cl.load_policy(given.policy).policy if given.policy else shipped()
        came, begun = provenance(), time.monotonic()
        for row in measure(base, SCALES[given.scale], given.processes, rows):
            took, begun = time.monotonic() - begun, time.monotonic()
            row |= {"rewards": np.round(row["rewards"], 4).tolist(), "seconds": round(took), "commit": came["commit"]}
            rows.append(row)
            given.out.mkdir(parents=True, exist_ok=True)
            file.write_text(
                json.dumps({**about, **came, "bound_deg": BOUND_DEG, "eps_deg": EPS_DEG, "rows": rows}) + "\n"
            )
            told = f"{row['what']} (seed {row['seed']}, {row['labels']} labels)"
            print(f"{told}: {mean(row['rewards'])} after {took:.0f} s", flush=True)
    except UserError as error:
        print(error)
        return 2
    except KeyboardInterrupt:
        print(f"\ninterrupted: --resume goes on from {file}")
        return 130
    print(table(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
