"""Configuration of the arm: its skill and reward, and changes of the world and of the preference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import jax.numpy as jnp

from cuelearner_envs.arm.environment import Arm, Camera, Reward, Skill
from cuelearner_envs.arm.physics import ArmGround
from cuelearner_jax.config import EPISODE, Bounds, check_part
from cuelearner_jax.environment import Quantity
from cuelearner_jax.errors import UserError

SIDES = {"none": 0.0, "left": 1.0, "right": -1.0}


@dataclass(frozen=True)
class ArmConfig:
    """A skill of the arm, and the world for it."""

    skill: Skill = "push"
    """reach: the gripper to a goal. push: a cube to a goal on the table. pick: a cube to one on or over the table."""
    reward: Reward = "shaped"
    """sparse: -1 per step until success, then 0. dense: the negative distance from the goal. shaped: dense, less half
    the distance from gripper to cube."""
    obstacle: bool = True
    """Skill push: place a post between cube and goal. Without the post, cube and goal lie as in FetchPush."""
    max_steps: Annotated[int, EPISODE] = 50
    """Steps of 0.04 s after which an episode is truncated."""
    within: Annotated[float, Bounds(0, above=True)] = 0.05
    """An episode is a success if it ends within this distance of the goal [m]."""
    camera_turn_deg: Annotated[float, Bounds(-180, 180)] = 0.0
    """Changed world: the camera is rotated clockwise about the robot's base by this angle [deg], so that goal and cube
    seem rotated counterclockwise."""
    camera_offset: Annotated[tuple[float, float, float], Bounds(-1, 1)] = (0.0, 0.0, 0.0)
    """Changed world: offset of the observed positions of goal and cube, x, y and z [m]."""
    friction: Annotated[float, Bounds(0.01, 10)] = 1.0
    """Changed world: friction of the cube on table, fingers and post."""
    preferred_side: Literal["none", "left", "right"] = "none"
    """Changed preference, with a post: the teacher pushes the cube past the post on this side."""

    def __post_init__(self) -> None:
        """Raise UserError with one line for the first value that cannot work."""
        check_part(self, "task")
        if self.preferred_side != "none" and not self.has_post:
            raise UserError(f"task.preferred_side is {self.preferred_side}: that needs --task.skill push and its post")

    @property
    def has_post(self) -> bool:
        """Whether a post stands on the table."""
        return self.skill == "push" and self.obstacle


def make_environment(config: ArmConfig, observation: Sequence[Quantity]) -> Arm:
    """Return the environment of a configuration; `observation`: names of its slices."""
    return Arm(
        camera=Camera(
            turn=jnp.deg2rad(jnp.float32(config.camera_turn_deg)), offset=jnp.array(config.camera_offset, jnp.float32)
        ),
        ground=ArmGround(friction=jnp.float32(config.friction), post=jnp.float32(config.has_post)),
        grasps=jnp.float32(config.skill == "pick"),
        within=jnp.float32(config.within),
        max_steps=jnp.int32(config.max_steps),
        skill=config.skill,
        reward=config.reward,
        observation=tuple(observation),
    )
