"""Evaluation from Python: what `cuelearner evaluate` measures, for any policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cuelearner_jax import user_code
from cuelearner_jax.api.policies import as_policy_in, config_of
from cuelearner_jax.api.worlds import World
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.studies import evaluate as study
from cuelearner_jax.studies.evaluate import Measured


@user_code.report_user_errors
def measure(
    policy: Any,
    world: World,
    *,
    episodes: int | None = None,
    steps: int | None = None,
    envs: int | None = None,
    engine: str | None = None,
) -> Measured:
    """Measure a policy on validation episodes of a world: the numbers of `cuelearner evaluate`.

    Args:
        policy: a policy, or any function of a batch of observations in NumPy.
        world: the world that the policy acts in.
        episodes: whole episodes, where the task counts episodes (default: 100).
        steps: environment steps in place of episodes (default, where the task counts steps: 10,000).
        envs: environments that share the steps (default: 100).
        engine: other physics that the world's robot has (default: its own).

    Returns:
        `metrics`: the mean (1,) of each metric by name; `each`: the environments' values (1, envs) of each metric.

    Raises:
        UserError: a policy that cannot act there, or amounts that cut episodes short.
    """
    source = PolicySource(world.task, config_of(policy, world), None, Path(world.task.name))
    request = study.EvaluateRequest(task=world.config, episodes=episodes, steps=steps, envs=envs, engine=engine)
    (found,) = study.run(source, request, policy=as_policy_in(policy, world.env))
    return found
