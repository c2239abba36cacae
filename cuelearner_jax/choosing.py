"""Where to ask: of several situations that on which members of a model disagree, or that a watching teacher picks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.actions import rotate
from cuelearner_jax.config import Scalars
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.policies import wanted_actions
from cuelearner_jax.types import GuideState, Teacher


def chosen(
    guidance: Guide,
    env: Environment,
    guide: GuideState,
    actions: Float[Array, "*candidates action"],
    first: Float[Array, "*candidates action"],
    away: Float[Array, " candidates"] | None = None,
) -> tuple[GuideState, Float[Array, " action"], Float[Array, " action"]]:
    """The guide in the one situation to ask in, the action to ask about there, and what was proposed there at first.

    Of several candidates it is the one on which the members of the guide's model disagree most (query by committee:
    Seung, Opper, Sompolinsky, 1992); before the first fit, when they know nothing, the first.

    Args:
        guidance, env: of the guide.
        guide: in the situations to choose from.
        actions: to ask about there.
        first: what the base policy proposes there.
        away: how far the actions are from a teacher's own, see `parting`: it chooses the farthest, fitted or not, and
            the first of several as far; None: members choose.
    """
    if guide.obs.ndim == 1 or (away is None and not guidance.has_members):
        return guide, actions, first
    if away is not None:
        index = jnp.argmax(away)
    else:
        apart = guidance.disagreement(guide.model, env, guide.obs, actions)
        index = jnp.where(guide.model.fitted, jnp.argmax(apart), 0)
    there = jax.tree.map(lambda leaf: leaf[index], (guide.env, guide.obs, actions, first))
    return guide.replace(env=there[0], obs=there[1]), there[2], there[3]


def parting(
    env: Environment,
    teacher: Teacher,
    scalars: Scalars,
    guide: GuideState,
    actions: Float[Array, "candidates action"],
) -> Float[Array, " candidates"]:
    """How far the action in each candidate is from what a simulated teacher would do there, its bias included [rad].

    A coach who watches speaks where that is most. The idea is that of interventions, in which an expert decides when to
    take over: Kelly, Sidrane, Driggs-Campbell, Kochenderfer, "HG-DAgger: Interactive imitation learning with human
    experts", ICRA 2019.
    """
    wanted = wanted_actions(teacher, guide.env, guide.obs, actions, scalars)
    return actions_of(env).distance(actions, rotate(wanted, scalars.radians("teacher_bias")))
