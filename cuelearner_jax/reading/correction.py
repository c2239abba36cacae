"""The correction of actions by an estimated change, and by a process for what depends on the situation."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from cuelearner_jax.reading import linear, posterior
from cuelearner_jax.reading.families import Family
from cuelearner_jax.reading.linear import SCALE, Change, ObservationFrame
from cuelearner_jax.reading.posterior import Posterior, Priors
from cuelearner_jax.spaces import Space


class Correction(struct.PyTreeNode):
    """The estimate of a change, and the process with which other errors are corrected."""

    change: Change
    frame: ObservationFrame
    known: Float[Array, "n z"]  # situations that the process was fitted in
    alpha: Float[Array, "n cues"]  # times its variance: weights of the situations
    length: Float[Array, " z"]  # length scale of each input of the process
    scale: Float[Array, ""]  # unit of changes, in the unit of `space.log`

    def more(self, space: Space, obs: Float[Array, "n obs"], action: Float[Array, "n a"]) -> Float[Array, "n cues"]:
        """Return the mean of the process, in units of `scale`; `action`: the base's."""
        inputs = linear.inputs(space, self.frame, obs, action)
        return posterior.correlation(self.length, inputs, self.known) @ self.alpha


def correction_of(
    fitted: Posterior,
    change: Change,
    frame: ObservationFrame,
    situations: Float[Array, "n z"],
    eps: Any,
    priors: Priors,
) -> Correction:
    """Return what is needed to act by a posterior."""
    alpha = posterior.amplitudes(fitted.hyper, priors)[None] ** 2 * fitted.alpha
    return Correction(
        change, frame, situations, alpha, posterior.lengths(fitted.hyper, priors), jnp.float32(SCALE * eps)
    )


def corrected(
    space: Space,
    family: Family,
    correction: Correction,
    obs: Float[Array, "n obs"],
    before: Float[Array, "n obs"],
    first: Float[Array, "n action"],
    action: Float[Array, "n action"],
) -> Float[Array, "n action"]:
    """Return corrected actions.

    Args:
        space, family, correction: the correction.
        obs, before: observations as they are, and as they would be without the change (`linear.undone`).
        first, action: what the policy does about the two.
    """
    base = linear.meant(family, correction.change.theta, before, action)
    more = correction.more(space, obs, first)
    return space.exp(base, correction.scale * (linear.basis(space, base) @ correction.change.action.T + more))
