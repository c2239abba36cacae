"""The inputs of networks: observation and action as they are, or the observation as it looks from the action.

In the action's frame (`frame` "action"), situations that differ by a rotation have the same inputs, and a network's
output for one holds for all of them. This is equivariance by the input (Wang, Walters, Platt, "SO(2)-equivariant
reinforcement learning", ICLR 2022; van der Pol et al., "MDP homomorphic networks", NeurIPS 2020).
"""

from __future__ import annotations

from typing import Any

import jax
from jaxtyping import Array, Float

from cuelearner_jax.config import Frame
from cuelearner_jax.environment import Spaces
from cuelearner_jax.errors import UserError


def network_inputs(
    frame: Frame, env: Any, obs: Float[Array, "*n obs"], actions: Float[Array, "*m action"]
) -> tuple[Float[Array, "*n own"], Float[Array, "*m turned"]]:
    """Return a network's inputs for observation and action.

    Args:
        frame: "raw": the two as they are; "action": the environment's `features`.
        env: provides the features; not used in the raw frame.
        obs: one observation (obs,) with any number of actions, or n observations with one action each.
        actions: (*m, action) or (n, action).
    """
    if frame == "raw":
        return obs, actions
    found = env.features(obs, actions) if obs.ndim == 1 else jax.vmap(env.features)(obs, actions)
    return found.own, found.turned


def widths(frame: Frame, spaces: Spaces) -> tuple[int, int]:
    """Return the sizes of a network's two inputs. Raises UserError if the environment has no `features`."""
    if frame == "raw":
        return spaces.obs_size, spaces.actions.size
    if spaces.features is None:
        raise UserError(
            "sizes.frame is 'action', but this task does not define an observation as seen from an action "
            "(`features`): give --sizes.frame raw"
        )
    return spaces.features


def outward(
    frame: Frame, spaces: Spaces, residual: Float[Array, "*n action"], actions: Float[Array, "*n action"]
) -> Float[Array, "*n action"]:
    """Return a network's output as a vector to add to the actions; in the action's frame it is a turn from there."""
    return residual if frame == "raw" else spaces.actions.outward(residual, actions)
