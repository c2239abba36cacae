"""Configuration of the navigation task: worlds, sensor, robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import jax
import jax.numpy as jnp

from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.lidar import Lidar
from cuelearner_envs.navigation.worlds import generate_many
from cuelearner_jax.config import EPISODE, SHARE, Bounds, check_part
from cuelearner_jax.errors import UserError

SIDES = {"none": 0, "left": 1, "right": -1}
MOST_WORLDS = 1 << 24  # replay keeps a world's number in single precision, which is exact up to here
# Folded into the key of the worlds, so that no training world is used for validation.
SPLITS = {"training": 0, "validation": 1, "tuning": 2}


@dataclass(frozen=True)
class NavigationConfig:
    """A family of worlds and the robot in it."""

    style: Literal["clutter", "rooms", "corridor"] = "clutter"
    """clutter: a hall of boxes and columns. rooms: rooms, doorways, thin obstacles. corridor: pass left or right."""
    worlds: Annotated[int, Bounds(1, MOST_WORLDS)] = 1024
    """Number of worlds, each with 16 routes. Training and validation use different worlds."""
    world_seed: Annotated[int, Bounds(0)] = 0
    """Seed of the worlds."""
    max_steps: Annotated[int, EPISODE] = 200
    """Largest number of steps of 0.2 s in an episode, after which it is truncated."""
    goal_radius: Annotated[float, Bounds(0, above=True)] = 0.5
    """The goal is reached within this distance at the end of a step, which may be 0.2 m long [m]."""
    max_range: Annotated[float, Bounds(0, above=True)] = 10.0
    """Range of the lidar [m]."""
    lidar_rotation_deg: float = 0.0
    """Changed world: the lidar is mounted rotated counterclockwise by this angle [deg] (paper: 15)."""
    lidar_noise: Annotated[float, Bounds(0)] = 0.0
    """Changed world: standard deviation of a beam's error [m]."""
    lidar_dropout: Annotated[float, SHARE] = 0.0
    """Changed world: probability that a beam reads the full range."""
    goal_rotation_deg: float = 0.0
    """Changed world: the measured direction to the goal is rotated counterclockwise by this angle [deg]."""
    mirrors: bool = False
    """Add the mirror images of transitions to replay, unless lidar or goal are rotated; labels are not mirrored."""
    look_ahead: bool = False
    """Add the length of a second leg to the ways that guidance intent compares. Observations do not change."""
    keep_scans: bool = False
    """Store scans in replay instead of scanning anew for each gradient step: faster on a CPU, 2.2 KB a step more."""
    preferred_side: Literal["none", "left", "right"] = "none"
    """Changed preference, in a corridor: the teacher passes every obstacle on this side."""

    def __post_init__(self) -> None:
        """Raise UserError with one line for the first value that cannot work."""
        check_part(self, "task")
        if self.preferred_side != "none" and self.style != "corridor":
            raise UserError(f"task.preferred_side is {self.preferred_side}: that needs --task.style corridor")


def make_environment(config: NavigationConfig, split: str = "training") -> Navigation:
    """The environment that a configuration describes, with the worlds of a split."""
    key = jax.random.fold_in(jax.random.key(config.world_seed), SPLITS[split])
    return Navigation(
        worlds=generate_many(key, config.worlds, config.style),
        lidar=Lidar(
            max_range=jnp.float32(config.max_range),
            rotation=jnp.deg2rad(jnp.float32(config.lidar_rotation_deg)),
            noise=jnp.float32(config.lidar_noise),
            dropout=jnp.float32(config.lidar_dropout),
        ),
        max_steps=jnp.int32(config.max_steps),
        goal_radius=jnp.float32(config.goal_radius),
        goal_rotation=jnp.deg2rad(jnp.float32(config.goal_rotation_deg)),
        mirrors=config.mirrors and not (config.lidar_rotation_deg or config.goal_rotation_deg),
        sides=config.style == "corridor",
        look_ahead=config.look_ahead,
        keep_scans=config.keep_scans,
    )
