"""Fetch seen by a camera whose place is not known exactly. Loads Gymnasium.

What a camera tells is displaced by a constant: the goal and the object, with all that derives from these. The gripper's
own place comes from the joints and is right.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from cuelearner_envs.fetch.scripts import SCRIPTS

# Slices that a camera measures: the goal and, with an object, its position (twice) and the vector to it.
SEEN = {"FetchReach-v4": (3,), "FetchPush-v4": (0, 3, 9, 12)}
REACH_WITHIN = 0.02  # [m]: Gymnasium's own 5 cm tolerate an error of 3 cm


class HandEye(gymnasium.ObservationWrapper):
    """An environment of Fetch whose camera is displaced by `offset` [m]; `within` [m]: how near the goal is success.

    Observations are dictionaries, as Fetch gives them.
    """

    def __init__(self, env: Any, offset: Any, within: float | None = None) -> None:
        super().__init__(env)
        self.offset, self.within = np.asarray(offset, float), within

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the observation that the displaced camera gives."""
        seen = {name: value.copy() for name, value in observation.items()}
        seen["desired_goal"] += self.offset
        if len(seen["observation"]) > 10:  # there is an object
            seen["achieved_goal"] += self.offset
            seen["observation"][3:9] += np.tile(self.offset, 2)
        return seen

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Execute an action; success is judged by true positions."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self.within is not None:
            away = np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"])
            info = {**info, "is_success": float(away < self.within)}
        return self.observation(obs), reward, terminated, truncated, info


class Onlooker(struct.PyTreeNode):
    """Teacher that runs the script on true positions."""

    offset: Float[Array, "3"]  # of the camera [m]
    environment: str = struct.field(pytree_node=False)

    def best_action(self, state: Any, obs: Float[Array, " obs"]) -> Float[Array, "4"]:
        """Return the script's action for the true positions."""
        true = obs
        for start in SEEN[self.environment]:
            true = true.at[start : start + 3].add(-self.offset)
        return SCRIPTS[self.environment](true[None])[0]


def onlooker(environment: str, offset: Any) -> Onlooker:
    """Return the teacher of an environment whose camera is displaced by `offset` [m]."""
    return Onlooker(jnp.asarray(offset, jnp.float32), environment)
