"""What the labelling page and its command tell a person to type next."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path
from typing import Any

from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.task import Task


def again(arguments: list[str]) -> str:
    """The command that was typed, once more; `arguments`: what stood after `label`."""
    return shlex.join(["cuelearner", "label", *arguments])


def following(task: Task, preset: str, config: RunConfig, asked: Any, policy: str | None, labels: int) -> str:
    """The command that uses so many labels: `train` for labels of chance, `adapt` for those about a policy.

    Args:
        task: that was labelled.
        preset: whose configuration was started from.
        config: that configuration.
        asked: the options of `cuelearner label`, with `task`, `sizes` and `scalars` as they were used.
        policy: which one the labels are about; None: chance.
        labels: how many there are.
    """
    name, out = task.origin or task.name, str(asked.out)
    if asked.again is not None:
        return shlex.join(["cuelearner", "labels", "inspect", str(asked.again), out])
    given = ["--labels-from", out, "--labels", str(labels)]
    if policy is None:
        words = ["train", name, "--preset", preset, "--guidance", asked.guidance, *given]
        parts = ("task", task.config), ("sizes", GuideSizes), ("scalars", GuideScalars)
        for part, kind in parts:
            words += _differing(part, kind, getattr(config, part), getattr(asked, part))
        return shlex.join(["cuelearner", *words, "--out", f"runs/{Path(out).name}"])
    words = ["adapt", policy, *(["--task", name] if not Path(policy).exists() else [])]
    words += [] if asked.scenario is None else ["--scenario", asked.scenario]
    words += [] if asked.robot is None else ["--robot", asked.robot]
    words += ["--guidance", asked.guidance, *given]
    words += _differing("task", task.config, config.task, asked.task)
    return shlex.join(["cuelearner", *words, "--out", f"policies/{Path(out).name}"])


def _differing(part: str, kind: type, before: Any, now: Any) -> list[str]:
    """The options that make one part of a configuration another."""
    words = []
    for field in dataclasses.fields(kind):
        value, option = getattr(now, field.name), field.name.replace("_", "-")
        if value == getattr(before, field.name):
            continue
        if isinstance(value, bool):
            words.append(f"--{part}.{option}" if value else f"--{part}.no-{option}")
        else:
            words += [f"--{part}.{option}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words
