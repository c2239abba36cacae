"""The correction alone: a corrected policy without its base, which stays where it is and gives its action beside.

A decision about observation and base action: what the contract calls the observation ends in the slice "base action".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.environment import Quantity, action_of, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import decisions
from cuelearner_jax.policies import PolicyNode, describe, uniform_in
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import EnvState

BASE = "base action"  # the last slice of what such a decision is about


class Given(PolicyNode):
    """Actions that come from elsewhere."""

    actions: Float[Array, "n action"]

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """These."""
        return self.actions

    def describe(self) -> dict[str, Any]:
        """A policy elsewhere."""
        return {"policy": "given"}


class CorrectionAlone(PolicyNode):
    """What a corrected policy makes of an action that its base, which is elsewhere, has chosen."""

    corrected: Any  # the policy, with any base
    space: Space = struct.field(pytree_node=False)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n seen"]) -> Float[Array, "n action"]:
        """The corrected actions of observations and base actions, one beside the other."""
        own, base = jnp.split(obs, [obs.shape[-1] - self.space.size], -1)
        base = self.space.retract(self.space.only_actions(base))
        return _over(self.corrected, Given(base)).act(key, states, own)

    def describe(self) -> dict[str, Any]:
        """The corrections, one over the other, of an action that is given."""
        return describe(_over(self.corrected, Given(jnp.zeros((1, self.space.size)))))


@dataclass(frozen=True)
class Beside:
    """Observation and action of a correction alone, as exporting asks an environment for it."""

    observation: tuple[Quantity, ...]
    actions: Space
    action: Quantity
    base_size: int  # entries at the end of what is seen that are the base's action

    @property
    def obs_size(self) -> int:
        """Number of entries that are seen."""
        return sum(quantity.size for quantity in self.observation)


def _over(policy: Any, base: Any) -> Any:
    """A corrected policy over another base."""
    below = policy.base
    return policy.replace(base=_over(below, base) if getattr(below, "base", None) is not None else base)


def correction_of(policy: Any, env: Any) -> tuple[CorrectionAlone, Beside]:
    """Return a policy's correction alone, and what that sees and does.

    Raises UserError for a policy that corrects nothing, or that shows its base other observations than there are.
    """
    if getattr(policy, "base", None) is None:
        raise UserError("this policy corrects no other one: give one that was corrected, or export the whole policy")
    layer = policy
    while (below := getattr(layer, "base", None)) is not None:
        asks = [one.name for one in getattr(layer, "family", ()) if one.asks]
        if asks:
            raise UserError(
                f"this policy asks its base about other observations ({asks[0]}), so its correction cannot stand "
                "alone: export the whole policy"
            )
        layer = below
    space, action = actions_of(env), action_of(env)
    seen = Quantity(BASE, space.size, action.unit, "what the base, which is elsewhere, would do")
    without = jax.tree.map(jnp.asarray, _over(policy, Given(jnp.zeros((1, space.size)))))
    return CorrectionAlone(without, space), Beside((*env.observation, seen), space, action, space.size)


def cases(env: Any) -> Float[np.ndarray, "n seen"]:
    """Return observations of a world with random actions beside, among which golden cases are chosen."""
    obs = decisions.observations(env, uniform_in(env))
    base = actions_of(env).sample(jax.random.key(1), (len(obs),))
    return np.concatenate([obs, np.asarray(base)], -1)
