"""The arm's teacher: a script that sees true places, knows the friction, and prefers a side of the post."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.arm.environment import Arm, Camera
from cuelearner_envs.arm.scripts import act
from cuelearner_jax.types import EnvState


class ScriptTeacher(struct.PyTreeNode):
    """Teacher that runs the skill's script on the true positions of gripper, cube and goal."""

    env: Arm
    side: Float[Array, ""] | float = 0.0  # of the post: +1 left, -1 right, 0 the shorter way

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, "4"]:
        """Return the script's action, of what an unchanged camera would show."""
        true = self.env.observe(state, Camera())[None]
        ground = self.env.ground
        friction, post = jnp.asarray(ground.friction), jnp.asarray(ground.post)
        return act(self.env.skill, true, self.side, friction, post)[0]
