"""Sizes of unknowns: so large that a change moves a policy's actions by a usual correction."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cuelearner_jax.reading import linear
from cuelearner_jax.reading.families import Family, undo_observation, unknowns_of
from cuelearner_jax.reading.fitting import Acts
from cuelearner_jax.spaces import Space

SITUATIONS = 16
SIZES = np.geomspace(1e-4, 1e3, 29)  # tried, in the unknown's unit
MOST = 1 / 4  # largest mean change of the actions, as a share of the space's reach


def steps_of(
    space: Space, family: Family, acts: Acts, obs: Float[Array, "n obs"], eps: float
) -> Float[Array, " unknowns"]:
    """Return the size of each unknown: its own scale, or the least that moves actions by `linear.SCALE` eps.

    An unknown that moves no action so far has the size that moves actions by half of the most.
    """
    obs = jnp.asarray(obs)[:: max(1, len(obs) // SITUATIONS)][:SITUATIONS]
    target = min(linear.SCALE * eps, float(space.from_unit(MOST * space.reach)))
    steps = []
    for place, unknown in enumerate(unknowns_of(family)):
        if unknown.scale is not None:
            steps.append(unknown.scale)
            continue
        sizes = SIZES[max(unknown.most / 4, SIZES[0]) >= SIZES]
        thetas = jnp.zeros((1 + len(sizes), len(unknowns_of(family)))).at[1:, place].set(jnp.asarray(sizes))
        before = _undone(family, thetas, obs)
        actions = acts(before.reshape(-1, before.shape[-1])).reshape(*before.shape[:2], -1)
        effects = np.asarray(_effects(space, family, thetas, before, actions))
        effects = np.minimum(effects, 3 * target).mean(1)
        enough = np.flatnonzero(effects >= min(target, 0.5 * max(effects.max(), 1e-12)))
        steps.append(float(sizes[enough[0]]) if effects.max() > 0 else float(sizes[-1]))
    return jnp.asarray(steps, jnp.float32)


@partial(jax.jit, static_argnames="family")
def _undone(family: Family, thetas: Array, obs: Array) -> Array:
    return jax.vmap(lambda theta: jax.vmap(partial(undo_observation, family, theta))(obs))(thetas)


@partial(jax.jit, static_argnames=("space", "family"))
def _effects(space: Space, family: Family, thetas: Array, before: Array, actions: Array) -> Array:
    whole = jax.vmap(partial(linear.meant, family))(thetas, before, actions)
    return jnp.abs(space.log(whole[:1], whole[1:])).max(-1)
