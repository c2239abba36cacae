"""Fetch whose camera stands 3 cm from where the arm believes, corrected by 100 labels of a teacher who sees the truth.

    python experiments/fetch_hand_eye.py --out runs/fetch [--pieces FetchPush-v4/reading/0] [--resume]

FetchReach and FetchPush of gymnasium_robotics (the extra `gymnasium`), played by scripted policies. A teacher of all
cues or of one at random answers; no rewarded step is taken: held-out labels judge. Controls: the policy as it was, and
models of labels that have each other's answers. Label seeds play episodes of their own, and each
of these is played by the policy as it was too, with the camera in its place and displaced. `--split tuning` plays
episodes, and asks with label seeds, on which nothing is reported. OUT/ENVIRONMENT/KIND/SEED.json grows as it measures.
At the scale `paper` a piece takes some minutes of one core; `--list` names them, `--table` prints what OUT has.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import cuelearner_jax as cl
from cuelearner_envs.fetch.scripts import SCRIPTS
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.bridges.gymnasium.layout import flatten, leaves_of
from cuelearner_jax.bridges.gymnasium.source import make_registered
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import mean_interval
from cuelearner_jax.policies import policy_of
from cuelearner_jax.storage.provenance import provenance
from cuelearner_jax.tasks import fetch_layout

OFFSET = (0.0, 0.03, 0.0)  # [m], to the left
WITHIN = {"FetchReach-v4": 0.02, "FetchPush-v4": 0.05}  # [m]: success; Gymnasium's 5 cm of a reach forgive the error
EPS, BOUND = 0.05, 0.5  # shares of a cue's range, chosen on tuning episodes
STEPS, SIDE_BY_SIDE = 50, 25  # of an episode; environments that play at once
FIRST_EPISODE = {"validation": 10_000, "tuning": 1_000}
FIRST_SEED = {"validation": 0, "tuning": 100}  # of labels
SIZES = GuideSizes(feedback_layers=(64, 64), fit_steps=400, fit_batch_size=64, labels_per_round=10, question_every=5)
Row = dict[str, Any]


class Scale(NamedTuple):
    """How much is asked and played."""

    labels: int
    episodes: int  # of each seed


class Condition(NamedTuple):
    """A variant measured beside the uncorrected policy."""

    says: str  # which cues the teacher speaks of
    shuffled: bool = False  # a control: labels have each other's answers


SCALES = {"smoke": Scale(20, 2), "quick": Scale(50, 20), "paper": Scale(100, 50)}
CONDITIONS = (Condition("all"), Condition("all", shuffled=True), Condition("one"))
KINDS = ("base", "reading", "relative")  # "base": the policy as it was, unchanged and displaced
SEEDS = range(4)  # of labels, each with its own policy
PIECES = tuple(f"{environment}/{kind}/{seed}" for environment in SCRIPTS for kind in KINDS for seed in SEEDS)


def hand_eye(environment: str, offset: Sequence[float]) -> Any:
    """An environment of Fetch whose camera is displaced."""
    from cuelearner_envs.fetch.hand_eye import HandEye  # loads Gymnasium

    return HandEye(make_registered(environment, {}, STEPS), offset, WITHIN[environment])


@cache
def world_of(environment: str) -> cl.World:
    """The displaced environment as a world: its slices and cues are Fetch's."""
    return cl.from_gymnasium(
        hand_eye,
        environment=environment,
        offset=list(OFFSET),
        observation=fetch_layout.layout_of(environment),
        cues=";".join(fetch_layout.CUES),
        processes=1,
    )


def play(environment: str, policy: Any, offset: Sequence[float], episodes: Sequence[int]) -> np.ndarray:
    """Success (episodes,) at the end of episodes of these seeds; a policy's own random numbers are always the same."""
    act = jax.jit(lambda obs: policy.act(jax.random.key(0), None, obs))
    found = []
    for start in range(0, len(episodes), SIDE_BY_SIDE):
        seeds = [*episodes[start : start + SIDE_BY_SIDE]]
        envs = _instances(environment, tuple(offset), SIDE_BY_SIDE)[: len(seeds)]
        leaves = leaves_of(environment, envs[0].observation_space)
        seen = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)]
        rows = np.zeros((SIDE_BY_SIDE, sum(leaf.size for leaf in leaves)), np.float32)
        success = np.zeros(len(seeds))
        for _ in range(STEPS):
            rows[: len(seeds)] = [flatten(leaves, one) for one in seen]
            actions = np.asarray(act(jnp.asarray(rows)))
            steps = [env.step(action) for env, action in zip(envs, actions, strict=False)]
            seen, success = [step[0] for step in steps], np.array([step[4]["is_success"] for step in steps])
        found.append(success)
    return np.concatenate(found)


@cache
def _instances(environment: str, offset: tuple[float, ...], count: int) -> list[Any]:
    return [hand_eye(environment, offset) for _ in range(count)]


def settings(kind: str, says: str, shuffled: bool, space: Any) -> Scalars:
    """Scalars of a kind in the space of Fetch's actions."""
    if kind == "reading":
        return dataclasses.replace(Scalars(), eps_deg=EPS, says=says)
    answer = "shuffled" if shuffled else "best"
    return dataclasses.replace(plain_scalars(space), eps_deg=EPS, tau_deg=EPS / 20, says=says, answer=answer)


def adapt(environment: str, kind: str, condition: Condition, labels: int, seed: int) -> cl.AdaptedPolicy:
    """The script after labels of one seed; held-out labels decide whether it is changed."""
    from cuelearner_envs.fetch.hand_eye import onlooker

    world, script = world_of(environment), policy_of(jax.jit(SCRIPTS[environment]))
    how: dict[str, Any] = {"guidance": kind, "judge_by": "labels", "seed": seed}
    scalars = settings(kind, condition.says, condition.shuffled, world.actions)
    if kind != "reading":
        how |= {"sizes": SIZES, "bound_deg": BOUND}
    found = cl.adapt(script, world, onlooker(environment, OFFSET), labels=labels, scalars=scalars, **how)
    if not condition.shuffled or kind != "reading":
        return found
    given = found.labels
    answer = np.random.default_rng(seed).permutation(np.asarray(given.answer))
    return cl.adapt(script, world, labels=given._replace(answer=answer), scalars=scalars, **how)


def measure(piece: str, scale: Scale, split: str, known: Sequence[Row]) -> Iterator[Row]:
    """Yield all measurements of a piece but the known ones, each as soon as it is made."""
    environment, kind, number = piece.split("/")
    done = {(row["what"], row["says"], row["shuffled"]) for row in known}
    first = FIRST_EPISODE[split] + int(number) * scale.episodes
    episodes, seed = range(first, first + scale.episodes), FIRST_SEED[split] + int(number)
    if kind == "base":
        script = policy_of(jax.jit(SCRIPTS[environment]), world_of(environment).actions)
        for what, offset in (("unchanged", (0.0, 0.0, 0.0)), ("displaced", OFFSET)):
            if (what, "", False) not in done:
                success = play(environment, script, offset, episodes)
                yield {"what": what, "says": "", "shuffled": False, "seed": seed, "success": success}
        return
    for condition in CONDITIONS:
        if (kind, *condition) in done:
            continue
        policy = adapt(environment, kind, condition, scale.labels, seed)
        told: Row = {"used": policy.used, "judged": [round(value, 4) for value in policy.judged[1:]]}
        if kind == "reading":
            told["estimates"] = [one.words() for one in policy.estimates]
        success = play(environment, policy.policy, OFFSET, episodes)
        row = {"what": kind, "says": condition.says, "shuffled": condition.shuffled, "seed": seed}
        yield {**row, **told, "rewarded_steps": policy.rewarded_steps, "success": success}


def run(piece: str, scale: str, split: str, out: Path, resume: bool) -> None:
    """Measure a piece and write after each measurement. Raises UserError for a file that is of something else."""
    file, rows = out / f"{piece}.json", []
    about = {"scale": scale, "split": split, "offset_m": list(OFFSET), "eps_shares": EPS, "bound_shares": BOUND}
    about |= {"within_m": WITHIN[piece.split("/", maxsplit=1)[0]]}
    if file.exists():
        found = json.loads(file.read_text())
        if not resume or {name: found.get(name) for name in about} != about:
            raise UserError(f"{file} exists: give another --out, or --resume with what it was made by")
        rows = found["rows"]
    begun = time.monotonic()
    for row in measure(piece, SCALES[scale], split, rows):
        took, begun = time.monotonic() - begun, time.monotonic()
        rows.append({**row, "success": [int(value) for value in row["success"]], "seconds": round(took)})
        file.parent.mkdir(parents=True, exist_ok=True)
        command = f"fetch_hand_eye.py --scale {scale} --split {split} --pieces {piece}"
        lines = ",\n".join("  " + json.dumps(one) for one in rows)
        head = json.dumps({**about, **provenance(), "command": command, "rows": []}, indent=1)
        file.write_text(head.replace('"rows": []', f'"rows": [\n{lines}\n ]') + "\n")
        words = [row["what"], row["says"], "shuffled" if row["shuffled"] else "", f"seed {row['seed']}"]
        told = f"{piece}: {' '.join(filter(None, words))}: {np.mean(row['success']):.1%}"
        print(f"{told} {row.get('judged', '')} {row.get('estimates', '')} ({took:.0f} s)", flush=True)


def table(folder: Path) -> str:
    """Return a line for each environment and condition: success of all seeds' episodes with its 95% interval."""
    found: dict[tuple[str, ...], list[int]] = {}
    for file in sorted(folder.glob("*/*/*.json")):
        for row in json.loads(file.read_text())["rows"]:
            words = (row["what"], row["says"], "shuffled" if row["shuffled"] else "")
            found.setdefault((file.parts[-3], " ".join(filter(None, words))), []).extend(row["success"])
    lines = []
    for (environment, name), success in found.items():
        mean, low, high = 100 * mean_interval(np.array(success, float))
        lines.append(f"{environment:<15}{name:<25}{mean:.1f} [{low:.1f}, {high:.1f}]")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure pieces."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", choices=list(SCALES), default="paper")
    parser.add_argument("--split", choices=list(FIRST_EPISODE), default="validation", help="episodes and label seeds")
    parser.add_argument("--pieces", nargs="+", choices=PIECES, metavar="PIECE", default=PIECES, help="default: all")
    parser.add_argument("--list", action="store_true", help="name the pieces and leave")
    parser.add_argument("--out", type=Path, default=Path("runs/fetch"), help="folder")
    parser.add_argument("--resume", action="store_true", help="keep what OUT has")
    parser.add_argument("--table", action="store_true", help="print what OUT has and leave")
    given = parser.parse_args(arguments)
    if given.table:
        print(table(given.out))
        return 0
    if given.list:
        print("\n".join(PIECES))
        return 0
    try:
        for piece in given.pieces:
            run(piece, given.scale, given.split, given.out, given.resume)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\ninterrupted: --resume goes on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
