"""How likely a relative answer is, when it is known what the teacher means.

An answer about an action is, with probability 1 - rho, an ordered logistic in the way from the action to what is meant:
"already right" near it, with a width w. With probability rho, it is about something else: more and less are then as
likely. An action far from what is meant tells nothing either: who looks for the nearest good action finds another
one there. How near and how far that is, rho and w are not known; they are values of a grid with a prior.
"""

from __future__ import annotations

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

RHO = (0.02, 0.1, 0.25, 0.45, 0.75)
WIDTH = (0.15, 0.5, 1.5, 5.0)  # [eps]
RIGHT = (0.5, 1.5)  # how far from what is meant an action is still right [eps]: as asked, or what else is good too
FAR = (10.0, 40.0)  # how far an answer is about what is meant [eps]
ZERO = (1 / 3, 0.06)  # share of "already right" in answers about something else: careless ones; about other actions
GRID = np.array(list(product(RHO, WIDTH, RIGHT, FAR, ZERO)))  # (grid, 5)
LOG_PRIOR = np.log((1 - GRID[:, 0]) / (1 - GRID[:, 0]).sum())  # (grid,)

Floats = np.ndarray


def chances(
    offset: Float[Array, "*n"], answer: Float[Array, "*n"] | float, doubt: Float[Array, "*n"]
) -> Float[Array, "*n grid"]:
    """Return the probability of an answer about one cue, for each point of the grid.

    Args:
        offset: how far it is from the action to what is meant [eps].
        answer: -1, 0 or 1.
        doubt: probability that the situation itself makes the answer one about something else.
    """
    offset, answer = offset[..., None], jnp.broadcast_to(jnp.asarray(answer), offset.shape)[..., None]
    of_grid = (jnp.asarray(part, jnp.float32).reshape(*[1] * (offset.ndim - 1), -1) for part in GRID.T)
    rho, width, right, far, zero = of_grid
    more = jax.nn.sigmoid((offset - right) / width)
    less = jax.nn.sigmoid((-offset - right) / width)
    told = jnp.where(answer > 0, more, jnp.where(answer < 0, less, 1 - more - less))
    sound = (1 - rho) * (1 - doubt[..., None]) * jnp.exp(-jnp.square(offset / far))
    other = jnp.where(answer == 0, zero, (1 - zero) / 2)
    return sound * jnp.maximum(told, 0.0) + (1 - sound) * other


@jax.jit
def log_chances(
    offset: Float[Array, "n cues"],
    answer: Float[Array, "n cues"],
    told: Float[Array, "n cues"],
    doubt: Float[Array, " n"],
) -> Float[Array, "n grid"]:
    """Return the logarithm of the probability of each answer, for each point of the grid.

    Args:
        offset: how far it is from the asked action to what is meant, along each cue [eps].
        answer: -1, 0 or 1 for each cue.
        told: 1 where something was said of a cue, else 0.
        doubt: of each answer's situation, see `chances`.
    """
    each = jnp.log(chances(offset, answer, jnp.broadcast_to(doubt[:, None], offset.shape)))
    return jnp.sum(each * told[..., None], 1)
