"""One world of the zoo as an environment of the package, and its teacher."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs.zoo import worlds
from cuelearner_envs.zoo.robots import policy
from cuelearner_envs.zoo.worlds import STEPS, State, ZooWorld
from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.spaces import DIRECTIONS, Box, Space
from cuelearner_jax.types import EnvState, Step


class ZooEnvironment(WholeObservations, struct.PyTreeNode):
    """One world as an environment (`cuelearner_jax.environment.Environment`); episodes are `STEPS` steps long.

    Observations have no names and no units. Make one by `ZooEnvironment.of`.
    """

    world: ZooWorld
    actions: Space = struct.field(pytree_node=False)
    observation: tuple[Quantity, ...] = struct.field(pytree_node=False)

    @classmethod
    def of(cls, world: ZooWorld) -> ZooEnvironment:
        """Return the environment of a world, whose robot's bounds must be concrete."""
        low, high = (tuple(np.asarray(bound).tolist()) for bound in (world.robot.low, world.robot.high))
        space = DIRECTIONS if world.robot.cues == 1 else Box(low, high)
        return cls(world, space, (Quantity("observation", world.robot.unit.shape[0], "1"),))

    def reset(self, key: PRNGKeyArray) -> tuple[EnvState, Float[Array, " obs"]]:
        """Begin an episode."""
        state = worlds.reset(key, self.world)
        return state, self.observe(state)

    def observe(self, state: State) -> Float[Array, " obs"]:
        """Return the observation of a state."""
        return worlds.observe(self.world, state)

    def step(self, key: PRNGKeyArray, state: EnvState, action: Float[Array, " action"]) -> tuple[EnvState, Step]:
        """Execute an action; a new episode follows the last step of one."""
        after, reward = worlds.step(self.world, state, action)
        outcome = {"success": worlds.success(self.world, after).astype(jnp.float32)}
        return self.step_to(key, after, reward, jnp.array(False), after.steps >= STEPS, {}, outcome)

    def heuristic(self, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the action of the robot's policy, which knows nothing of what is wrong."""
        return policy(self.world.robot, obs)


class ZooTeacher(struct.PyTreeNode):
    """Teacher that knows what is wrong in its world."""

    world: ZooWorld

    def best_action(self, state: State, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return the right action; see `worlds.right`."""
        return worlds.right(self.world, state)
