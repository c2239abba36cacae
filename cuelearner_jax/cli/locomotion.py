"""`cuelearner locomotion train` and `cuelearner locomotion evaluate`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from cuelearner_jax.bridges import walking
from cuelearner_jax.bridges.walking import LocomotionConfig
from cuelearner_jax.cli.parsing import HELP, out, parse, summary
from cuelearner_jax.errors import UserError, closest
from cuelearner_jax.tasks.walking import anymal


@dataclass(frozen=True)
class LocomotionTrain:
    """Train the quadruped's walking policy."""

    out: Path = Path("runs/anymal-policy")
    """Folder for the policy."""
    train: LocomotionConfig = field(default_factory=LocomotionConfig)
    seed: int = 0
    """Seed."""


@dataclass(frozen=True)
class LocomotionEvaluate:
    """Measure a walking policy in MJX and in C MuJoCo."""

    policy: tyro.conf.Positional[Path | None] = None
    """Folder of a policy (default: the shipped one)."""
    robots: int = 512
    """Robots that walk for 20 s in each trial."""
    seed: int = 1
    """Decides commands, grounds, noise and pushes."""
    out: Path | None = None
    """Also write the figures to this JSON file."""


OPTIONS = {"locomotion train": LocomotionTrain, "locomotion evaluate": LocomotionEvaluate}


def run(arguments: list[str]) -> None:
    """Runs the command. Raises what `walking.train` and `walking.evaluate` raise."""
    kinds = {name.split()[1]: kind for name, kind in OPTIONS.items()}
    if not arguments or arguments[0] in HELP:
        print(f"usage: cuelearner locomotion {'|'.join(kinds)} [OPTIONS]\n")
        for name, kind in kinds.items():
            print(f"  {name:<10}{summary(kind)}")
        raise SystemExit(0 if arguments else 2)
    if arguments[0] not in kinds:
        raise UserError(f"unknown command 'locomotion {arguments[0]}'{closest(arguments[0], kinds)}")
    asked = parse(kinds[arguments[0]], arguments[1:], f"locomotion {arguments[0]}")
    command = shlex.join(["cuelearner", "locomotion", *arguments])
    if isinstance(asked, LocomotionTrain):
        walking.check(asked.train)
        walking.train(anymal(), asked.train, asked.out, asked.seed, command, out.print)
    else:
        walking.evaluate(anymal(), asked.policy, asked.robots, asked.seed, command, asked.out, out.print)
    if asked.out:
        out.print(f"wrote {asked.out}")
