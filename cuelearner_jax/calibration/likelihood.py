"""The likelihood of a relative answer, given the action that the teacher means.

With probability 1 - rho an answer is about the meant action: an ordered logistic in the offset from the asked action to
the meant one, with "already right" near zero and a width w. With probability rho it is about another action; more and
less are then equally likely. An answer about an action far from the meant one tells nothing either, since a teacher who
looks for the nearest good action finds another one there. The limits of near and far, rho and w are unknown: they are
points of a grid with a prior. Where the policy itself is not sure what it means, its spread adds to the width.
"""

from __future__ import annotations

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

RHO = (0.02, 0.1, 0.25, 0.45, 0.75)
WIDTH = (0.15, 0.5, 1.5, 5.0)  # [eps]
RIGHT = (0.5, 1.5)  # distance at which an action is still right [eps]: as asked, or with other good actions
FAR = (10.0, 40.0)  # distance up to which an answer is about the meant action [eps]
ZERO = (1 / 3, 0.06)  # share of "already right" in other answers: careless ones, or about other actions
GRID = np.array(list(product(RHO, WIDTH, RIGHT, FAR, ZERO)))  # (grid, 5)
LOG_PRIOR = np.log((1 - GRID[:, 0]) / (1 - GRID[:, 0]).sum())  # (grid,)
# A logarithm costs more than all else here. Chances are 0.001 at least, so that float32 holds such a product.
TOGETHER = 8
LOGISTIC = np.pi**2 / 3  # variance of a logistic distribution of width 1


def chances(
    offset: Float[Array, "*n"],
    spread: Float[Array, "*n"],
    answer: Float[Array, "*n"] | float,
    doubt: Float[Array, "*n"] | float = 0.0,
) -> Float[Array, "*n grid"]:
    """Return the probability of an answer about one cue, for each point of the grid.

    Args:
        offset: mean distance from the asked action to the meant one [eps].
        spread: standard deviation of that [eps].
        answer: -1, 0 or 1.
        doubt: probability that the situation makes the answer one about another action.
    """
    shape = jnp.shape(offset)
    offset, spread, answer, doubt = (
        jnp.broadcast_to(jnp.asarray(part, jnp.float32), shape)[..., None, None, None, None, None]
        for part in (offset, spread, answer, doubt)
    )
    # One axis for each parameter, so that terms of few parameters are computed once.
    axes = np.meshgrid(RHO, WIDTH, RIGHT, FAR, ZERO, indexing="ij", sparse=True)
    rho, width, right, far, zero = (part.astype(np.float32)[(None,) * len(shape)] for part in axes)
    variance = jnp.square(spread)
    width = jnp.sqrt(jnp.square(width) + variance / LOGISTIC)
    more = jax.nn.sigmoid((offset - right) / width)
    less = jax.nn.sigmoid((-offset - right) / width)
    told = jnp.where(answer > 0, more, jnp.where(answer < 0, less, 1 - more - less))
    reach = jnp.square(far) + 2 * variance
    near = far / jnp.sqrt(reach) * jnp.exp(-jnp.square(offset) / reach)  # the mean over the spread
    sound = (1 - rho) * (1 - doubt) * near
    other = jnp.where(answer == 0, zero, (1 - zero) / 2)
    chance = sound * jnp.maximum(told, 0.0) + (1 - sound) * other
    return jnp.reshape(chance, (*shape, len(GRID)))


def log_chances(
    offset: Float[Array, "*samples n cues"],
    spread: Float[Array, "*samples n cues"],
    answer: Float[Array, "n cues"],
    told: Float[Array, "n cues"],
    doubt: Float[Array, " n"],
) -> Float[Array, "*samples n grid"]:
    """Return the logarithm of the probability of each answer, for each point of the grid.

    Args:
        offset: distance from the asked action to the meant one, along each cue [eps].
        spread: standard deviation of that [eps].
        answer: -1, 0 or 1 for each cue.
        told: 1 where the answer says something of a cue, else 0.
        doubt: each situation's doubt, see `chances`.
    """
    return _log_product(_of_cues(offset, spread, answer, told, doubt))


def log_chance(
    offset: Float[Array, "*samples n cues"],
    spread: Float[Array, "*samples n cues"],
    answer: Float[Array, "n cues"],
    told: Float[Array, "n cues"],
    doubt: Float[Array, " n"],
) -> Float[Array, "*samples grid"]:
    """Return the logarithm of the probability of all answers together; arguments as in `log_chances`."""
    each = _of_cues(offset, spread, answer, told, doubt)
    return _log_product(each.reshape(*each.shape[:-3], -1, each.shape[-1]))


def _of_cues(offset: Array, spread: Array, answer: Array, told: Array, doubt: Array) -> Array:
    """The probability of what is said of each cue (samples, n, cues, grid); 1 where nothing is said."""
    answer, told, doubt = (jnp.broadcast_to(part, offset.shape) for part in (answer, told, doubt[:, None]))
    return jnp.where(told[..., None] > 0, chances(offset, spread, answer, doubt), 1.0)


def _log_product(chance: Float[Array, "*rows factors grid"]) -> Float[Array, "*rows grid"]:
    """The logarithm of a product, which takes one logarithm for every `TOGETHER` factors."""
    groups = -(-chance.shape[-2] // TOGETHER)
    more = [(0, 0)] * (chance.ndim - 2) + [(0, groups * TOGETHER - chance.shape[-2]), (0, 0)]
    padded = jnp.pad(chance, more, constant_values=1.0)
    grouped = padded.reshape(*chance.shape[:-2], groups, TOGETHER, chance.shape[-1])
    return jnp.sum(jnp.log(jnp.prod(grouped, -2)), -2)
