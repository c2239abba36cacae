"""A policy corrected for changes of its world: it gets the undistorted observation, and its action is corrected."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.calibration.families import Family, undo_action, undo_observation, undo_physics, unknowns_of
from cuelearner_jax.guides.calibration import KIND
from cuelearner_jax.policies import BY_LANE, SHARED, PolicyNode, describe
from cuelearner_jax.types import EnvState


class Calibrated(PolicyNode):
    """Another policy corrected for the changes of a family; with all unknowns at zero it acts as its base."""

    base: Any  # a policy
    theta: Float[Array, " unknowns"]  # unknowns in their units; of a block (lanes, unknowns)
    family: Family = struct.field(pytree_node=False)
    # reference of the family's code; empty: the world declares the family
    named: str = struct.field(pytree_node=False, default="")

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the base's actions, corrected."""
        before = jax.vmap(partial(undo_observation, self.family, self.theta))(obs)
        meant = jax.vmap(partial(undo_physics, self.family, self.theta))(before, self.base.act(key, states, before))
        return jax.vmap(partial(undo_action, self.family, self.theta))(meant)

    @property
    def axes(self) -> Calibrated:
        """Lane axes: each lane has its own base, and its own unknowns where there is more than one."""
        return self.replace(base=self.base.axes, theta=SHARED if jnp.ndim(self.theta) == 1 else BY_LANE)

    def describe(self) -> dict[str, Any]:
        """Return the changes, their sizes (a value a lane for a block) with units, and the base."""
        values = zip(unknowns_of(self.family), np.asarray(self.theta).T.tolist(), strict=True)
        changes = [{"name": one.name, "value": value, "unit": one.unit} for one, value in values]
        distortions = {"distortions": [one.name for one in self.family], "changes": changes, "code": self.named}
        return {"policy": "calibrated", "guidance": KIND.name, **distortions, "base": describe(self.base)}
