"""Relative feedback that refines uniform actions in place of the agent's, as the public code's trainer has it.

Named as `_from_chance:KIND` wherever a kind of guidance is asked for, in the folder that holds this file or by a script
in it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.guides import relative
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.types import GuidanceModel

FACTOR = 0x9E3779B1  # Knuth's multiplicative hash: every entry's bits count, in their place


def key_of(obs: Float[Array, " obs"]) -> PRNGKeyArray:
    """A random key of a situation."""
    bits = jax.lax.bitcast_convert_type(obs, jnp.uint32)
    places = jnp.arange(1, len(bits) + 1, dtype=jnp.uint32) * jnp.uint32(FACTOR)
    return jax.random.key(jnp.sum(bits * places, dtype=jnp.uint32))


class FromChance(relative.Relative):
    """The refinement of a uniform action, the same wherever the situation is the same."""

    def act(
        self,
        model: GuidanceModel,
        env: Any,
        obs: Float[Array, "n obs"],
        actions: Float[Array, "n action"],
        active: Bool[Array, " n"],
        scalars: GuideScalars,
    ) -> Refinement:
        """Eq. 4 from a uniform action on, in active rows of a fitted model."""
        space = self.spaces.actions
        uniform = jax.vmap(lambda row: space.sample(key_of(row), ()))(obs)
        begins = active & model.fitted
        return super().act(model, env, obs, jnp.where(begins[:, None], uniform, actions), active, scalars)


KIND = replace(relative.KIND, name="relative-from-chance", guide=FromChance, title="relative, from uniform actions")
