"""Billiards whose teacher may be an agent, `--task.teacher RUN`, and whose shots Chipmunk may play, `--robot chipmunk`.

The public code's teacher imitates an agent that was trained for long on raw coordinates; the shipped teachers search
exactly. RUN is the folder of that agent's run. Named as `_agent_teacher:TASK` wherever a task is asked for, in the
folder that holds this file or by a script in it.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
from _coarse_step import BODY
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.billiards.config import BilliardsConfig
from cuelearner_jax.runs.trained import PolicySource, one_policy
from cuelearner_jax.storage.folders import CONFIG
from cuelearner_jax.tasks.billiards import BILLIARDS
from cuelearner_jax.types import EnvState, Teacher


class AgentTeacher(struct.PyTreeNode):
    """A trained agent's own action is what it would choose (`cuelearner_jax.types.Teacher`)."""

    agent: Any  # a policy

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """The agent's action."""
        return self.agent.act(jax.random.key(0), None, obs[None])[0]  # agents draw nothing


def make_teacher(config: BilliardsConfig, env: Any) -> Teacher:
    """The first agent of a run folder, or the teacher that the task itself has of that name."""
    folder = Path(config.teacher)
    if not (folder / CONFIG).is_file():
        return BILLIARDS.make_teacher(config, env)
    source = PolicySource.of_run(folder, lambda name: BILLIARDS)  # whose observations this task has
    return AgentTeacher(one_policy(source, source.config.task, "agent", None, None, None, None, env))


def _files(config: BilliardsConfig) -> dict[str, str]:
    return {} if (Path(config.teacher) / CONFIG).is_file() else BILLIARDS.files(config)


TASK = dataclasses.replace(
    BILLIARDS, name="billiards_by_agents", bodies=(*BILLIARDS.bodies, BODY), teacher=make_teacher, files=_files
)
