"""Where to ask: of several situations that on which the members of a model disagree most."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.environment import Environment
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.types import GuideState


def chosen(
    guidance: Guide,
    env: Environment,
    guide: GuideState,
    actions: Float[Array, "*candidates action"],
    first: Float[Array, "*candidates action"],
) -> tuple[GuideState, Float[Array, " action"], Float[Array, " action"]]:
    """The guide in the one situation to ask in, the action to ask about there, and what was proposed there at first.

    Of several candidates it is the one on which the members of the guide's model disagree most (query by committee:
    Seung, Opper, Sompolinsky, 1992); before the first fit, when they know nothing, the first.

    Args:
        guidance, env: of the guide.
        guide: in the situations to choose from.
        actions: to ask about there.
        first: what the base policy proposes there.
    """
    if guide.obs.ndim == 1 or not guidance.has_members:
        return guide, actions, first
    apart = guidance.disagreement(guide.model, env, guide.obs, actions)
    index = jnp.where(guide.model.fitted, jnp.argmax(apart), 0)
    there = jax.tree.map(lambda leaf: leaf[index], (guide.env, guide.obs, actions, first))
    return guide.replace(env=there[0], obs=there[1]), there[2], there[3]
