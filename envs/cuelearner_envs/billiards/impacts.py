"""Impulses between discs: an elastic impact with Coulomb friction, as a rigid-body engine resolves a single contact.

For discs both impulses have closed forms. Balls have mass 1 and the moment of a solid disc, r^2/2. Spin is carried as
the speed of the ball's rim, q = r * angular velocity, counterclockwise positive [m/s], so that no radius appears.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_envs.billiards.table import Scalar

# 1 / effective mass along the tangent: each disc adds 1/m + r^2/I = 3. Along the normal each disc adds 1.
TANGENT_PER_DISC = 3.0
RIM_PER_IMPULSE = -2.0  # change of a rim's speed by a unit tangential impulse, -r^2/I; the same for both discs
LEAST_SEPARATION = 1e-6  # [m/s] well above float32 rounding: a pair parts after an impact, so none repeats at once
SOFT_SPEED = 1e-3  # [m/s] slower impacts are elastic: else balls that lie together would collide without end


def normal_impulse(
    approach: Float[Array, "*any"] | float,
    unseen: Float[Array, "*any"] | float,
    restitution: Scalar,
    discs: Float[Array, "*any"] | float,
) -> Float[Array, "*any"]:
    """Impulse along the normal: (1 + e) * approach / discs (Newton's restitution); `discs` = 1 or 2 movable bodies.

    `unseen` is the share of the true approach speed that the flight does not carry (the part of a kick due before the
    impact but applied after it). The impact acts on the true speed; the flight keeps its bookkeeping.
    """
    true_approach = approach + unseen
    separation = jnp.where(true_approach > SOFT_SPEED, restitution, 1.0) * true_approach + unseen
    return (approach + jnp.maximum(separation, LEAST_SEPARATION)) / discs


def tangential_impulse(
    slip: Float[Array, "*any"] | float,
    normal: Float[Array, "*any"] | float,
    friction: Scalar,
    discs: Float[Array, "*any"] | float,
) -> Float[Array, "*any"]:
    """Impulse along the tangent: it ends the slip, or is clamped to Coulomb's cone (as in Chipmunk's arbiter)."""
    most = friction * normal
    return jnp.clip(-slip / (TANGENT_PER_DISC * discs), -most, most)
