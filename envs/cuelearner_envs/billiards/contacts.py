"""Time and place of a disc's next contact in straight flight, and the impulses there.

Everything here is geometry of uniform motion: x(s) = x + u s. All quantities are components, so that the same
lines serve one ball or an array of them. Times never come out negative: an overlap left by rounding counts as a
contact now, so nothing can tunnel.

A contact is an elastic impact with Coulomb friction, as a rigid-body engine resolves a single one: for discs both
impulses have closed forms. Balls have mass 1 and the moment of a solid disc, r^2/2. Spin is carried as the speed of the
ball's rim, q = r * angular velocity, counterclockwise positive [m/s], so that no radius appears.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cuelearner_envs.billiards.table import Scalar, Table, corner_gap

Each = Float[Array, "*any"]  # a number of one ball, or of each of many
# 1 / effective mass along the tangent: each disc adds 1/m + r^2/I = 3. Along the normal each disc adds 1.
TANGENT_PER_DISC = 3.0
RIM_PER_IMPULSE = -2.0  # change of a rim's speed by a unit tangential impulse, -r^2/I; the same for both discs
LEAST_SEPARATION = 1e-6  # [m/s] well above float32 rounding: a pair parts after an impact, so none repeats at once
SOFT_SPEED = 1e-3  # [m/s] slower impacts are elastic: else balls that lie together would collide without end


class Flight(NamedTuple):
    """A ball's next contact, other balls apart."""

    time: Each  # until then; infinite if nothing
    centre_x: Each  # point of the cushion's centre line that it touches [m]
    centre_y: Each  # [m]
    falls: Bool[Array, "*any"]  # it drops into a pocket instead of touching a cushion


def time_to_circle(dx: Each, dy: Each, ux: Each, uy: Each, radius: Scalar) -> Each:
    """Time until a point, displaced by d from a circle's centre and moving with u, enters the circle.

    The smaller root of |d + u t| = radius, in the form c / (-b + sqrt(disc)) that does not cancel; the discriminant
    is written with the cross product for the same reason. Only an approaching point (d.u < 0) can hit.
    """
    toward = -(dx * ux + dy * uy)
    missed_by = dx * uy - dy * ux
    discriminant = (ux * ux + uy * uy) * radius * radius - missed_by * missed_by
    gap = jnp.maximum(dx * dx + dy * dy - radius * radius, 0.0)
    hits = (toward > 0.0) & (discriminant > 0.0)
    time = gap / jnp.where(hits, toward + jnp.sqrt(jnp.maximum(discriminant, 0.0)), 1.0)
    return jnp.where(hits, time, jnp.inf)


def time_to_line(distance: Each, speed: Each) -> Each:
    """Time to cover a distance at a speed >= 0: at once if already beyond, never if at rest."""
    return jnp.where(speed > 0.0, jnp.maximum(distance, 0.0) / jnp.where(speed > 0.0, speed, 1.0), jnp.inf)


def jaws(table: Table, x: Each, y: Each) -> tuple[tuple[Each, Each], tuple[Each, Each]]:
    """The two cushion ends beside the pocket nearest to a place close to the table's edge [m]."""
    half_x, half_y, gap = table.width / 2, table.height / 2, corner_gap(table)
    sign_x, sign_y = jnp.where(x < 0.0, -1.0, 1.0), jnp.where(y < 0.0, -1.0, 1.0)
    first = sign_x * (half_x - gap), sign_y * half_y
    second = sign_x * half_x, sign_y * (half_y - gap)
    if table.side_pockets:
        at_side = jnp.abs(x) < (half_x - gap + table.hole_width) / 2  # halfway along the cushion between the pockets
        first = jnp.where(at_side, table.hole_width, first[0]), first[1]
        second = jnp.where(at_side, -table.hole_width, second[0]), jnp.where(at_side, first[1], second[1])
    return first, second


def next_on_edge(table: Table, x: Each, y: Each, ux: Each, uy: Each) -> Flight:
    """Return the next contact on the table's edge of a ball at (x, y) moving with (ux, uy).

    A straight flight leaves the inner rectangle (the edge less ball and cushion radius) exactly once. Where it does, it
    touches a cushion's straight part or enters a pocket's mouth, where only that pocket's two jaws can be in the way. A
    ball that already is in a mouth can meet the jaws there first. So four circles stand for all eight or twelve jaws.
    """
    half_x, half_y, gap = table.width / 2, table.height / 2, corner_gap(table)
    reach = table.ball_radius + table.cushion_radius
    sign_x, sign_y = jnp.where(ux < 0.0, -1.0, 1.0), jnp.where(uy < 0.0, -1.0, 1.0)
    out_x, out_y = sign_x * x, sign_y * y  # how far out in the direction of motion
    speed_x, speed_y = jnp.abs(ux), jnp.abs(uy)

    time_x = time_to_line(half_x - reach - out_x, speed_x)
    time_y = time_to_line(half_y - reach - out_y, speed_y)
    by_end = time_x <= time_y
    leaves = jnp.minimum(time_x, time_y)
    wait = jnp.where(jnp.isinf(leaves), 0.0, leaves)
    exit_x, exit_y = x + ux * wait, y + uy * wait
    straight = jnp.where(by_end, jnp.abs(exit_y) <= half_y - gap, jnp.abs(exit_x) <= half_x - gap)
    if table.side_pockets:
        straight &= by_end | (jnp.abs(exit_x) >= table.hole_width)

    best = jnp.where(straight, leaves, jnp.inf)
    best_x = jnp.where(by_end, sign_x * half_x, exit_x)
    best_y = jnp.where(by_end, exit_y, sign_y * half_y)
    for jaw_x, jaw_y in (*jaws(table, exit_x, exit_y), *jaws(table, x, y)):
        time = time_to_circle(x - jaw_x, y - jaw_y, ux, uy, reach)
        sooner = time < best
        best, best_x, best_y = (jnp.where(sooner, *both) for both in ((time, best), (jaw_x, best_x), (jaw_y, best_y)))

    pocket = jnp.minimum(
        time_to_line(half_x + table.pocket_margin - out_x, speed_x),
        time_to_line(half_y + table.pocket_margin - out_y, speed_y),
    )
    return Flight(jnp.minimum(best, pocket), best_x, best_y, pocket < best)


def normal_impulse(approach: Each | float, unseen: Each | float, restitution: Scalar, discs: Each | float) -> Each:
    """Impulse along the normal: (1 + e) * approach / discs (Newton's restitution); `discs` = 1 or 2 movable bodies.

    `unseen` is the share of the true approach speed that the flight does not carry (the part of a kick due before the
    impact but applied after it). The impact acts on the true speed; the flight keeps its bookkeeping.
    """
    true_approach = approach + unseen
    separation = jnp.where(true_approach > SOFT_SPEED, restitution, 1.0) * true_approach + unseen
    return (approach + jnp.maximum(separation, LEAST_SEPARATION)) / discs


def tangential_impulse(slip: Each | float, normal: Each | float, friction: Scalar, discs: Each | float) -> Each:
    """Impulse along the tangent: it ends the slip, or is clamped to Coulomb's cone (as in Chipmunk's arbiter)."""
    most = friction * normal
    return jnp.clip(-slip / (TANGENT_PER_DISC * discs), -most, most)
