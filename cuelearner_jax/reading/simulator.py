"""Changes of the physics, whose compensating action is found in a simulator with the unknowns as parameters.

A tilted table changes neither the observation nor the executed action, but the action's effect. A simulator of the
world can play actions near the meant one, before and after the change. The compensating action is the one around which
rewards after the change match the rewards around the meant action before the change. Where the change also decides how
wide the window of good actions is, its rewards match nowhere: `aim` compares the best actions instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_jax.errors import UserError
from cuelearner_jax.reading.families import Distortion, Unknown
from cuelearner_jax.spaces import Space

NARROW = 0.5  # standard deviation of the window in which rewards are compared, in reaches
GOOD = 0.95  # share of the largest expected reward with which an action is as good as the best


def simulator_distortion(
    name: str,
    unknowns: tuple[Unknown, ...],
    env_of: Callable[[Float[Array, " unknowns"]], Any],
    state_of: Callable[[Float[Array, " obs"]], Any],
    space: Space,
    reach: float,
    tried: int = 13,
    aim: float | None = None,
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
        aim: an action changes as much as the best one within the reach does, for a player who errs by this standard
            deviation, in the space's unit. None: rewards are matched.
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

    if aim is None:
        return Distortion(name, unknowns, plans=plans)
    near = away[half : half + tried]
    errs = jnp.exp(-0.5 * jnp.square((near[:, None] - near[None]) / space.from_unit(aim)))
    errs = errs / errs[half].sum()

    def best(env: Any, state: Any, action: Array) -> Array:
        expected = jnp.einsum("ij,j->i", errs, rewards(env, state, action, near), precision=jax.lax.Precision.HIGHEST)
        good = expected >= GOOD * expected.max() - 1e-6
        return near[jnp.argmin(jnp.where(good, jnp.abs(near), jnp.inf))]

    def follows(theta: Array, obs: Array, action: Array) -> Array:
        state = state_of(obs)
        before = best(env_of(jnp.zeros_like(theta)), state, action)
        return space.exp(action, (best(env_of(theta), state, action) - before)[None])

    return Distortion(name, unknowns, plans=follows)
