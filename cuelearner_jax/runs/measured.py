"""Measure named policies on validation episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from cuelearner_jax.evaluate import Rolled, Tell, episodes, part_of, untold, watched, watched_lanes
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Common
from cuelearner_jax.runs.trained import POLICIES, Parts, PolicySource, blocks_of
from cuelearner_jax.task import Rollout


class Measured(NamedTuple):
    """A policy's metrics under one guidance and budget."""

    guidance: str
    labels: int
    step: int  # of its training; 0: nothing was trained
    seeds: np.ndarray  # (seeds,)
    metrics: dict[str, np.ndarray]  # each (seeds,)
    each: dict[str, np.ndarray]  # the same of each environment (seeds, envs), nan where its first episode goes on
    bound_deg: float | None = None  # of a policy folder's lanes [deg]
    is_shared: bool = False  # do all seeds have one policy?


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
            means, each = _of_lanes([engine(policy, env, key, num_envs, steps, tell)])
        else:
            means, each = _repeated(watched(env, policy, key, num_envs, steps, tell), 1)
        return [Measured("-", 0, 0, np.zeros(1, int), means, each)]
    rows = []
    for block in blocks_of(source, named, env, teacher, tuple(map(guidances.named, kinds))):
        tell, policy, count = watch(block.guidance), block.policy, len(block.seeds)
        is_shared = isinstance(policy, Common)
        if engine:
            tells = [part_of(tell, lane, count) for lane in range(count)]
            means, each = _of_lanes(
                [engine(block.alone(lane), env, key, num_envs, steps, tells[lane]) for lane in range(count)]
            )
        elif is_shared:
            means, each = _repeated(watched(env, policy.policy, key, num_envs, steps, tell), count)
        else:
            means, each, _ = watched_lanes(env, policy, key, num_envs, steps, tell)
        variants = sorted(set(zip(block.bounds.tolist(), block.budgets.tolist(), strict=True)))
        for bound, budget in variants:
            own = (block.budgets == budget) & (block.bounds == bound)
            mine, apart = ({name: np.asarray(of[name])[own] for name in of} for of in (means, each))
            bounded = None if source.adapted is None else bound
            rows.append(Measured(block.guidance, budget, block.step, block.seeds[own], mine, apart, bounded, is_shared))
    return rows


def _of_lanes(lanes: list[dict[str, Any]]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Means (lanes,) and values (lanes, envs) of what an engine gave for each lane."""
    each = {name: np.stack([np.asarray(lane[name], float) for lane in lanes]) for name in lanes[0]}
    return {name: values.mean(-1) for name, values in each.items()}, each


def _repeated(rolled: Rolled, lanes: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Means (lanes,) and values (lanes, envs) of a policy that all lanes share."""
    means, each, _ = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], lanes, axis=0), rolled)
    return means, each
