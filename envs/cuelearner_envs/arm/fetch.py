"""The arm in Gymnasium-Robotics' Fetch: this camera and these rewards, Fetch's physics, no post."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs.arm.config import ArmConfig
from cuelearner_envs.arm.config import make_environment as make_arm
from cuelearner_envs.arm.environment import Arm, Camera
from cuelearner_envs.arm.physics import REACH, WORKSPACE, ArmGround
from cuelearner_envs.fetch.scripts import GOAL, GRIPPER, OBJECT
from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError
from cuelearner_jax.types import Step

CLEAR = 0.42  # of the gripper [m]: lower, Fetch's fingers touch the table
ACHIEVED, RELATIVE = slice(0, 3), slice(12, 15)  # in an observation


class FetchState(struct.PyTreeNode):
    """State between steps."""

    episode: Any  # of what plays Fetch
    true: Float[Array, " obs"]  # what an unchanged camera shows

    @property
    def goal(self) -> Float[Array, "3"]:
        """The goal [m]."""
        return self.true[GOAL]


class FetchArm(Arm, kw_only=True):
    """The environment (`cuelearner_jax.environment.Environment`), to agents the same as `Arm`.

    Rewards, success and what a displaced camera shows follow from Fetch's observation.
    """

    plays: Environment  # Fetch, whose observations are those of an unchanged camera

    def reset(self, key: PRNGKeyArray) -> tuple[FetchState, Float[Array, " obs"]]:
        """Begin an episode, as Fetch draws it."""
        state = FetchState(*self.plays.reset(key))
        return state, self.observe(state)

    def step(self, key: PRNGKeyArray, state: FetchState, action: Float[Array, "4"]) -> tuple[FetchState, Step]:
        """Execute an action; a new episode follows the end of one.

        Its target keeps within the workspace, as in `physics.command`, and above the table. Fetch itself would press
        the fingers on it, where friction holds them.
        """
        lowest, highest = (jnp.asarray(WORKSPACE).at[0, 2].set(CLEAR) - state.true[None, GRIPPER]) / REACH
        change = jnp.clip(jnp.clip(action[:3], lowest, highest), -1.0, 1.0)
        episode, step = self.plays.step(key, state.episode, action.at[:3].set(change))
        following, after = FetchState(episode, step.obs), FetchState(episode, step.final_obs)
        final_obs, distance = self.observe(after), self.distance(after)
        success = (distance < self.within).astype(jnp.float32)
        return following, step.replace(
            obs=self.observe(following),
            final_obs=final_obs,
            aftermath=final_obs,
            reward=self._earned(after),
            metrics={"within": success},
            outcome={"success": success, "distance": distance},
        )

    def gripper(self, state: FetchState) -> Float[Array, "3"]:
        """Return the gripper's place [m]."""
        return state.true[GRIPPER]

    def cube(self, state: FetchState) -> Float[Array, "3"]:
        """Return the place of the cube's middle [m]."""
        return state.true[OBJECT]

    def observe(self, state: FetchState, camera: Camera | None = None) -> Float[Array, " obs"]:
        """Return what the camera sees; `camera`: in place of the robot's own."""
        camera, true = self.camera if camera is None else camera, state.true
        view = true.at[GOAL].set(camera.view_of(state.goal))
        if not self.has_object:
            return view
        cube = camera.view_of(self.cube(state))
        return view.at[ACHIEVED].set(cube).at[OBJECT].set(cube).at[RELATIVE].set(cube - self.gripper(state))


def make_environment(config: ArmConfig, plays: Environment) -> FetchArm:
    """Return the environment of a configuration. Raises UserError for a change that Fetch cannot have.

    `plays`: Fetch in the skill and steps of the configuration. Whether a post is asked for does not count.
    """
    reasons = {"friction": "Fetch's cube has a friction of its own", "preferred_side": "no post stands in Fetch"}
    for name, why in reasons.items():
        if (value := getattr(config, name)) != getattr(ArmConfig, name):
            raise UserError(f"task.{name} is {value}, but {why}: leave it out, or leave out --robot fetch")
    plain = make_arm(config, plays.observation)
    ground = ArmGround(friction=plain.ground.friction, post=jnp.zeros(()))
    return FetchArm(**{**vars(plain), "ground": ground}, plays=plays)
