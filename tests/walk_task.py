"""A walk along a line by actions of a box, which ends off the line or by time; and a small soft actor-critic."""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import probes
from flax import struct

from cuelearner_jax.agents import sac
from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import Box
from cuelearner_jax.task import Body, Task
from cuelearner_jax.types import Step

BOX = Box((-1.0, 0.0), (3.0, 0.5))  # the first entry less 1 moves, the second does nothing
EDGE, STEPS = 1.0, 4


class Walk(WholeObservations, struct.PyTreeNode):
    """Place x moves by a quarter of the first entry less 1, pays -|x|, terminates past `EDGE`, ends after 4 steps."""

    wrong: jax.Array | float = 0.0  # by how much the heuristic errs

    observation = (Quantity("place", 1, "m"), Quantity("time", 1, "1"))
    actions = BOX

    def reset(self, key):
        state = jnp.stack([jax.random.uniform(key, minval=-0.5, maxval=0.5), 0.0])
        return state, state

    def step(self, key, state, action):
        final = jnp.stack([state[0] + 0.25 * (action[0] - 1), state[1] + 1 / STEPS])
        terminated = jnp.abs(final[0]) > EDGE
        truncated = (final[1] >= 1) & ~terminated
        obs = jnp.where(terminated | truncated, self.reset(key)[1], final)
        return obs, Step(obs, final, final, -jnp.abs(final[0]), terminated, truncated, {}, {})

    def heuristic(self, obs):
        return jnp.stack([jnp.clip(1 - 4 * obs[0] + self.wrong, -1, 3), 0.25])


SMALL = sac.SACConfig(
    actor_layers=(8,), critic_layers=(8,), batch_size=8, replay_capacity=96, actor_rate=1e-3, critic_rate=1e-3
)


@dataclass(frozen=True)
class WalkConfig:
    """The walk as a task's configuration."""

    wrong: float = 0.0
    """By how much the heuristic errs."""


TASK = Task("walk", "a walk", WalkConfig, (Body("point", "", lambda config, split: Walk(jnp.float32(config.wrong))),))


def config(agent=SMALL, arbiter=None, **groups):
    """A tiny run of the walk."""
    groups = {"scalars": {"discount": 0.9}, **groups}
    return dataclasses.replace(probes.config(arbiter, **groups), agent=agent, task=WalkConfig())
