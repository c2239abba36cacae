"""What named policies are worth: measured on validation episodes, and written with where the numbers come from."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.config import to_json
from cuelearner_jax.evaluate import Tell, episodes, part_of, untold, watched, watched_lanes
from cuelearner_jax.guidance import registry as guidances
from cuelearner_jax.policies import Common
from cuelearner_jax.records.provenance import provenance
from cuelearner_jax.records.whole import replacing
from cuelearner_jax.runs.trained import POLICIES, Parts, PolicySource, blocks_of
from cuelearner_jax.task import Rollout


class Measured(NamedTuple):
    """A policy's metrics under one guidance and budget."""

    guidance: str
    labels: int
    step: int
    seeds: np.ndarray  # (seeds,)
    metrics: dict[str, np.ndarray]  # each (seeds,)
    bound_deg: float | None = None  # of a policy folder's lanes [deg]


def evaluate(
    source: PolicySource,
    world: Any,
    name: str,
    kinds: tuple[str, ...],
    num_envs: int,
    steps: int,
    engine: Rollout | None = None,
    watch: Callable[[str], Tell] = lambda kind: untold,
) -> list[Measured]:
    """Metrics of a policy on validation episodes of a world (a task configuration), for each guidance and budget.

    Args:
        source: where the policy comes from.
        world: a task configuration.
        name: of the policy.
        kinds: of guidance of the run (none named: all).
        num_envs, steps: as `evaluate.rollout` has them.
        engine: a roll-out in other physics (default: the environment's own).
        watch: by kind of guidance, who is told how far its lanes are.
    """
    named, key = POLICIES[name], episodes()
    env = source.task.environment(world, "validation")
    teacher = source.task.make_teacher(world, env) if named.taught else None
    if not named.kept:
        policy = named.make(Parts(source.config, env, teacher, None))
        tell = watch(name)
        if engine:
            found = engine(policy, env, key, num_envs, steps, tell)
        else:
            found = watched(env, policy, key, num_envs, steps, tell)
        metrics = {metric: np.asarray(value)[None] for metric, value in found.items()}
        return [Measured("-", 0, 0, np.zeros(1, int), metrics)]
    rows = []
    for block in blocks_of(source, named, env, teacher, tuple(map(guidances.named, kinds))):
        tell, policy, count = watch(block.guidance), block.policy, len(block.seeds)
        if engine:
            each = []
            for lane in range(count):
                each.append(engine(block.alone(lane), env, key, num_envs, steps, part_of(tell, lane, count)))
            found = {metric: np.stack([measured[metric] for measured in each]) for metric in each[0]}
        elif isinstance(policy, Common):
            shared = watched(env, policy.policy, key, num_envs, steps, tell)
            found = {metric: np.repeat(np.asarray(value)[None], count) for metric, value in shared.items()}
        else:
            found = watched_lanes(env, policy, key, num_envs, steps, tell)
        variants = sorted(set(zip(block.bounds.tolist(), block.budgets.tolist(), strict=True)))
        for bound, budget in variants:
            own = (block.budgets == budget) & (block.bounds == bound)
            metrics = {metric: np.asarray(values)[own] for metric, values in found.items()}
            bounded = None if source.adapted is None else bound
            rows.append(Measured(block.guidance, budget, block.step, block.seeds[own], metrics, bounded))
    return rows


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def write(
    path: Path,
    source: PolicySource,
    world: Any,
    policy: str,
    num_envs: int,
    steps: int,
    measured: list[Measured],
    body: dict[str, str],
) -> None:
    """Measurements as JSON, with the world, the body if it is not the task's own, and where the numbers come from."""
    rows = [
        {
            "guidance": row.guidance,
            "labels": row.labels,
            **({} if row.bound_deg is None else {"bound_deg": float(f"{row.bound_deg:g}")}),
            "trained_steps": row.step,
            "seeds": row.seeds.tolist(),
            **{metric: [_finite(value) for value in values.tolist()] for metric, values in row.metrics.items()},
        }
        for row in measured
    ]
    contents = {
        "subject": source.folder.name,
        "world": {"name": source.task.name, **to_json(world)},
        **({"files": files} if POLICIES[policy].taught and (files := source.task.files(world)) else {}),
        "policy": policy,
        **body,
        "envs": num_envs,
        "steps": steps,
        **provenance(),
        "rows": rows,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(json.dumps(contents, indent=1) + "\n")
