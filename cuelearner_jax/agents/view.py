"""What networks see of an observation and an action: the two as they are, or the one as it looks from the other.

Seen from the action (`frame` "action"), situations that differ by a turn look alike, and what a network says of one
holds for all of them: a way to equivariance by the input (Wang, Walters, Platt, "SO(2)-equivariant reinforcement
learning", ICLR 2022; van der Pol et al., "MDP homomorphic networks", NeurIPS 2020).
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
    """What a network takes for observation and action.

    Args:
        frame: "raw": the two as they are; "action": the environment's `features`.
        env: whose features they are; nothing is asked of it in the raw frame.
        obs: one observation (obs,) with any number of actions, or n observations with one action each.
        actions: (*m, action) or (n, action).
    """
    if frame == "raw":
        return obs, actions
    found = env.features(obs, actions) if obs.ndim == 1 else jax.vmap(env.features)(obs, actions)
    return found.own, found.turned


def widths(frame: Frame, spaces: Spaces) -> tuple[int, int]:
    """Entries of the two parts of what is seen. Raises UserError if the environment cannot be seen so."""
    if frame == "raw":
        return spaces.obs_size, spaces.actions.size
    if spaces.features is None:
        raise UserError(
            "sizes.frame is 'action', but this task does not say how an observation looks from an action "
            "(`features`): give --sizes.frame raw"
        )
    return spaces.features


def outward(
    frame: Frame, spaces: Spaces, residual: Float[Array, "*n action"], actions: Float[Array, "*n action"]
) -> Float[Array, "*n action"]:
    """A network's residual as a vector to be added to the actions: in the action's frame it is a turn from there."""
    return residual if frame == "raw" else spaces.actions.outward(residual, actions)
