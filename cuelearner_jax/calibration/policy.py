"""A policy behind the changes of its world: it sees what it would have seen, and does what it meant."""

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
    """Another policy's actions, behind the changes of a family; with all unknowns at zero that policy's own."""

    base: Any  # a policy
    theta: Float[Array, " unknowns"]  # in their units; of a block (lanes, unknowns)
    family: Family = struct.field(pytree_node=False)
    named: str = struct.field(pytree_node=False, default="")  # code of the family; empty: the world declares it

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """The base's actions, corrected."""
        before = jax.vmap(partial(undo_observation, self.family, self.theta))(obs)
        meant = jax.vmap(partial(undo_physics, self.family, self.theta))(before, self.base.act(key, states, before))
        return jax.vmap(partial(undo_action, self.family, self.theta))(meant)

    @property
    def axes(self) -> Calibrated:
        """Each lane has its own base, and what changed where there is more than one."""
        return self.replace(base=self.base.axes, theta=SHARED if jnp.ndim(self.theta) == 1 else BY_LANE)

    def describe(self) -> dict[str, Any]:
        """What has changed, by how much (of a block a value a lane) and in which unit, and the base."""
        values = zip(unknowns_of(self.family), np.asarray(self.theta).T.tolist(), strict=True)
        changes = [{"name": one.name, "value": value, "unit": one.unit} for one, value in values]
        distortions = {"distortions": [one.name for one in self.family], "changes": changes, "code": self.named}
        return {"policy": "calibrated", "guidance": KIND.name, **distortions, "base": describe(self.base)}
