"""Changes of the physics, whose compensating action is found in a simulator with the unknowns as parameters.

A tilted table changes neither the observation nor the executed action, but the action's effect. A simulator of the
world can play actions near the meant one, before and after the change. The compensating action is the one around which
rewards after the change match the rewards around the meant action before the change.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.calibration.families import Distortion, Unknown
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Space

NARROW = 0.5  # standard deviation of the window in which rewards are compared, in reaches


def simulator_distortion(
    name: str,
    unknowns: tuple[Unknown, ...],
    env_of: Callable[[Float[Array, " unknowns"]], Any],
    state_of: Callable[[Float[Array, " obs"]], Any],
    space: Space,
    reach: float,
    tried: int = 13,
) -> Distortion:
    """Return a distortion of the physics, as a simulator predicts it.

    Args:
        name: name of the distortion.
        unknowns: parameters of the simulator; at zero it is the world of the policy.
        env_of: gives the environment of some unknowns; its `step(key, state, action)` tells the reward.
        state_of: gives a state of the simulator that looks like an observation.
        space: space of the actions, with one cue.
        reach: how far an action may have to change, in the space's unit.
        tried: actions within the reach of another one; odd.

    Raises:
        UserError: actions with several cues, or a number of tries that has no middle.
    """
    if len(space.cues) != 1:
        raise UserError(f"{name!r} is simulated for actions with one cue, not {len(space.cues)}: give `acts` instead")
    if tried < 3 or tried % 2 == 0:
        raise UserError(f"{name!r} tries {tried} actions: give an odd number of at least 3")
    half = tried // 2
    away = jnp.arange(-2 * half, 2 * half + 1) * (space.from_unit(reach) / half)  # actions tried after the change
    number = jnp.arange(tried)
    window = jnp.exp(-0.5 * jnp.square((number - half) / (NARROW * half)))

    def rewards(env: Any, state: Any, action: Array, changes: Array) -> Array:
        key = jax.random.key(0)  # the unknowns affect only the step that follows an action
        play = lambda change: env.step(key, state, space.exp(action, change[None]))[1].reward  # noqa: E731
        return jax.vmap(play)(changes)

    def plans(theta: Array, obs: Array, action: Array) -> Array:
        state = state_of(obs)
        before = rewards(env_of(jnp.zeros_like(theta)), state, action, away[half : half + tried])
        after = rewards(env_of(theta), state, action, away)
        shifted = after[number[:, None] + number[None]]  # (change, action near it)
        unlike = jnp.sum(window[None] * jnp.square(shifted - before[None]), -1)
        nearest = jnp.abs(number - half) * (1e-4 / tried)  # the middle one of equal actions
        best = jnp.where(before.any(), jnp.argmin(unlike + nearest), half)
        return space.exp(action, away[half + best][None])

    return Distortion(name, unknowns, plans=plans)
