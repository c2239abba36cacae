"""Export a correction alone: a corrected policy without its base, which runs elsewhere and supplies its action.

Such a decision takes observation and base action. In the contract, the observation ends with a slice "base action".
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.environment import BASE, Quantity, action_of, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import decisions
from cuelearner_jax.policies import PolicyNode, describe, uniform_in
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import EnvState


class FixedActions(PolicyNode):
    """Policy with fixed actions, supplied from elsewhere."""

    KIND = "given"

    actions: Float[Array, "n action"]

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return the supplied actions."""
        return self.actions


class CorrectionAlone(PolicyNode):
    """The correction of an action that a base policy elsewhere has chosen."""

    corrected: Any  # the policy, with any base
    space: Space = struct.field(pytree_node=False)

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n seen"]) -> Float[Array, "n action"]:
        """Return the corrected actions for rows of observation and base action, concatenated."""
        own, base = jnp.split(obs, [obs.shape[-1] - self.space.size], -1)
        base = self.space.retract(self.space.only_actions(base))
        return _over(self.corrected, FixedActions(base)).act(key, states, own)

    def describe(self) -> dict[str, Any]:
        """Describe the nested corrections of a supplied action."""
        return describe(_over(self.corrected, FixedActions(jnp.zeros((1, self.space.size)))))


def _over(policy: Any, base: Any) -> Any:
    """Return a corrected policy with its innermost base replaced."""
    below = policy.base
    return policy.replace(base=_over(below, base) if getattr(below, "base", None) is not None else base)


def correction_of(policy: Any, env: Any) -> tuple[CorrectionAlone, Any]:
    """Return a policy's correction alone, and what export needs to know of its input and output in place of a world."""
    if getattr(policy, "base", None) is None:
        raise UserError("this policy has no correction: give a corrected policy, or export the whole policy")
    layer = policy
    while (below := getattr(layer, "base", None)) is not None:
        if getattr(layer, "sees", False):
            raise UserError(
                "this policy asks its base about other observations than are met, so its correction cannot be exported "
                "alone: export the whole policy if its base is of JAX functions, or use it in Python (cl.load_policy)"
            )
        layer = below
    space, action = actions_of(env), action_of(env)
    base = Quantity(BASE, space.size, action.unit, "what the base, which is elsewhere, would do")
    without = jax.tree.map(jnp.asarray, _over(policy, FixedActions(jnp.zeros((1, space.size)))))
    size = env.obs_size + space.size
    beside = SimpleNamespace(observation=(*env.observation, base), obs_size=size, actions=space, action=action)
    beside.base_size = space.size  # number of entries at the end of the input that are the base's action
    return CorrectionAlone(without, space), beside


def cases(env: Any) -> Float[np.ndarray, "n seen"]:
    """Return a world's observations with random base actions appended, from which golden cases are chosen."""
    obs = decisions.observations(env, uniform_in(env))
    base = actions_of(env).sample(jax.random.key(1), (len(obs),))
    return np.concatenate([obs, np.asarray(base)], -1)
