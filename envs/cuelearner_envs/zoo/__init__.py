"""A zoo: small robots drawn by chance, in changed worlds, on which methods that correct policies are judged.

`robots` draws a group; `change` the world of an error; `rollout` plays an episode; `answer` is the teacher's. All are
pure JAX. `robots` takes many robots, the others one world, to be mapped by `jax.vmap`.
"""

from cuelearner_envs.zoo.distil import robots
from cuelearner_envs.zoo.robots import TASKS, ZooRobot, policy
from cuelearner_envs.zoo.worlds import (
    ERRORS,
    STEPS,
    State,
    ZooWorld,
    answer,
    change,
    observe,
    reset,
    right,
    rollout,
    step,
    unchanged,
)  # fmt: skip

__all__ = [
    "ERRORS", "STEPS", "TASKS", "State", "ZooRobot", "ZooWorld", "answer", "change", "observe", "policy", "reset",
    "right", "robots", "rollout", "step", "unchanged",
]  # fmt: skip
