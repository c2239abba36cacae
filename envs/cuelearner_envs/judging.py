"""First episodes in another engine, with the starts, policies and keys of `cuelearner_jax.evaluate`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from cuelearner_jax.types import Policy


def in_threads(one: Callable[[Any], None], numbers: Iterable[int | np.integer]) -> None:
    """Call a function for each robot, on all cores: MuJoCo releases Python's lock."""
    numbers = list(numbers)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(one, numbers, chunksize=max(1, len(numbers) // 8)))


def rollout(
    begin: Callable[[PRNGKeyArray], Any],
    policy: Policy,
    key: PRNGKeyArray,
    num_envs: int,
    steps: int,
    tell: Callable[[int, int], None] = lambda count_so_far, count: None,
) -> dict[str, np.ndarray]:
    """Roll out first episodes alone; `tell` receives how many steps of how many each robot has made.

    `begin` makes robots side by side, each in an episode: their `state` and `obs` lead with (robots,), and `step` takes
    actions and returns outcomes and whether the episodes ended, each (robots,).

    Returns outcomes of each episode (num_envs,), nan where it has not ended within `steps` shared by all, and
    "finished".
    """
    k_reset, k_run = jax.random.split(key)
    course = begin(jax.random.split(k_reset, num_envs))
    choose = jax.jit(policy.act)
    running, outcomes = np.ones(num_envs, bool), {}
    for index in range(steps // num_envs):
        tell(index, steps // num_envs)
        k_act, _ = jax.random.split(jax.random.fold_in(k_run, index))
        outcome, ends = course.step(choose(k_act, course.state, course.obs))
        ended = running & ends
        for name, values in outcome.items():
            outcomes.setdefault(name, np.full(num_envs, np.nan))[ended] = np.asarray(values)[ended]
        running &= ~ended
        if not running.any():
            break
    return {**outcomes, "finished": 1.0 - running}
