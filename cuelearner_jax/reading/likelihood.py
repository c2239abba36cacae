"""Probability of relative answers: each says in which interval the right action lies, seen from the action asked about.

An ordinal probit: t is the change from the action asked about to the right one along a cue, and `tau` the threshold.
`width` is the standard deviation of what is judged, and `lapse` the share of answers that are about something else.

    p(h | t) = (1 - lapse) (Phi((upper(h) - t) / width) - Phi((lower(h) - t) / width)) + lapse / 3
    more: (tau, inf)    right: [-tau, tau]    less: (-inf, -tau)

At the end of a cue's range "right" also says that the right action would lie beyond the end: the interval of an action
that cannot be raised by `tau` has no upper end, and likewise below. So a policy that saturates says nothing wrong.
"More" of such an action cannot be done and is read as "right", so that probabilities are at most 1 together.

Source: Chu, Ghahramani, "Gaussian processes for ordinal regression", JMLR 2005.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float

from cuelearner_jax.spaces import UNSAID

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()
FAR = 30.0  # widths beyond which an end counts as infinite: the normal distribution has nothing there in float32


class Answers(struct.PyTreeNode):
    """Relative answers, and the interval that each names."""

    lower: Float[Array, "n cues"]  # ends of the interval in units of tau: -1, 1 or infinite
    upper: Float[Array, "n cues"]
    valid: Bool[Array, "n cues"]  # False: nothing was said of this cue


class Habits(NamedTuple):
    """How a teacher answers, in the unit of the changes."""

    tau: Float[Array, ""]  # an action within this of the right one is called right
    width: Float[Array, ""]  # standard deviation of a judgement
    lapse: Float[Array, ""]  # share of answers that are about something else


def intervals(
    answer: Float[Array, "n cues"],
    valid: Bool[Array, " n"],
    below: Float[Array, "n cues"],
    above: Float[Array, "n cues"],
    tau: Float[Array, ""] | float,
) -> Answers:
    """Return the intervals of answers; `below`, `above`: how far each action can be changed before its range ends."""
    least, most = below < tau, above < tau
    less, more = (answer < 0) & ~least, (answer > 0) & (answer != UNSAID) & ~most
    upper = jnp.where(more | (most & ~less), jnp.inf, jnp.where(less, -1.0, 1.0))
    lower = jnp.where(less | (least & ~more), -jnp.inf, jnp.where(more, 1.0, -1.0))
    return Answers(lower, upper, valid[:, None] & (answer != UNSAID))


def log_likelihood(change: Float[Array, "n cues"], answers: Answers, habits: Habits) -> Float[Array, "n cues"]:
    """Return log p(answer | change) of each cue, 0 where nothing was said."""
    upper, lower = (ndtr(end) for end in _ends(change, answers, habits))
    return jnp.where(answers.valid, jnp.log((1 - habits.lapse) * (upper - lower) + habits.lapse / 3), 0.0)


def _ends(change: Array, answers: Answers, habits: Habits) -> tuple[Array, Array]:
    """Return both ends of the interval, seen from a change, in widths; an infinite end is `FAR` away."""

    def away(end: Array) -> Array:
        finite = jnp.isfinite(end)
        inside = (jnp.where(finite, end, 0.0) * habits.tau - change) / habits.width
        return jnp.where(finite, inside, jnp.where(end > 0, FAR, -FAR))

    return away(answers.upper), away(answers.lower)


def expected_log_likelihood(
    mean: Float[Array, "n cues"], variance: Float[Array, "n cues"], answers: Answers, habits: Habits
) -> Float[Array, "n cues"]:
    """Return E[log p(answer | change)] over normally distributed changes, by Gauss-Hermite quadrature."""
    nodes, shares = jnp.asarray(_NODES, jnp.float32), jnp.asarray(_WEIGHTS, jnp.float32)
    values = jax.vmap(lambda node: log_likelihood(mean + node * jnp.sqrt(variance), answers, habits))(nodes)
    return jnp.tensordot(shares, values, 1)


def predictive_log_likelihood(
    mean: Float[Array, "n cues"], variance: Float[Array, "n cues"], answers: Answers, habits: Habits
) -> Float[Array, "n cues"]:
    """Return log E[p(answer | change)] over normally distributed changes."""
    return log_likelihood(mean, answers, habits._replace(width=jnp.sqrt(habits.width**2 + variance)))


def curvature(
    mean: Float[Array, "n cues"], variance: Float[Array, "n cues"], answers: Answers, habits: Habits
) -> tuple[Float[Array, "n cues"], Float[Array, "n cues"]]:
    """Return first and second derivative of `expected_log_likelihood` by the mean."""
    slope = jax.grad(lambda mean: expected_log_likelihood(mean, variance, answers, habits).sum())
    return jax.jvp(slope, (mean,), (jnp.ones_like(mean),))
