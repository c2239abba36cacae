"""How likely a relative answer is, when it is known what the teacher means.

An answer about an action is, with probability 1 - rho, an ordered logistic in the way from the action to what is meant:
"already right" within eps / 2, with a width w. With probability rho, it is about something else: each of the three
answers is as likely. An action far from everything meant tells nothing either: who looks for the nearest good action
finds another one there. Rho and w are not known; they are values of a grid with a prior.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

RHO = np.array([0.02, 0.08, 0.18, 0.3, 0.5, 0.8])
WIDTH = np.array([0.1, 0.25, 0.6, 1.5, 3.5, 8.0])  # in eps
FAR = 30.0  # [eps]: answers about actions so far from what is meant are about something else
GRID = np.array([(rho, width) for rho in RHO for width in WIDTH])  # (grid, 2)
LOG_PRIOR = np.log(np.repeat((1 - RHO) / (1 - RHO).sum(), len(WIDTH)) / len(WIDTH))  # (grid,)
ANSWERS = np.array([-1.0, 0.0, 1.0])

Floats = np.ndarray


def chances(
    offset: Float[Array, "*n"], answer: Float[Array, "*n"] | float, doubt: Float[Array, "*n"]
) -> Float[Array, "*n grid"]:
    """Return the probability of an answer about one cue, for each rho and w of the grid.

    Args:
        offset: how far it is from the action to what is meant [eps].
        answer: -1, 0 or 1.
        doubt: probability that the situation itself makes the answer one about something else.
    """
    offset, answer = offset[..., None], jnp.broadcast_to(jnp.asarray(answer), offset.shape)[..., None]
    rho, width = (jnp.asarray(part, jnp.float32).reshape(*[1] * (offset.ndim - 1), -1) for part in GRID.T)
    more = jax.nn.sigmoid((offset - 0.5) / width)
    less = jax.nn.sigmoid((-offset - 0.5) / width)
    told = jnp.where(answer > 0, more, jnp.where(answer < 0, less, 1 - more - less))
    sound = (1 - rho) * (1 - doubt[..., None]) * jnp.exp(-jnp.square(offset / FAR))
    return sound * jnp.maximum(told, 0.0) + (1 - sound) / 3


@jax.jit
def log_chances(
    offset: Float[Array, "n cues"],
    answer: Float[Array, "n cues"],
    told: Float[Array, "n cues"],
    doubt: Float[Array, " n"],
) -> Float[Array, "n grid"]:
    """Return the logarithm of the probability of each answer, for each rho and w of the grid.

    Args:
        offset: how far it is from the asked action to what is meant, along each cue [eps].
        answer: -1, 0 or 1 for each cue.
        told: 1 where something was said of a cue, else 0.
        doubt: of each answer's situation, see `chances`.
    """
    each = jnp.log(chances(offset, answer, jnp.broadcast_to(doubt[:, None], offset.shape)))
    return jnp.sum(each * told[..., None], 1)
