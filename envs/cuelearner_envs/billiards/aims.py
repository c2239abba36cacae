"""Candidate shots of a player: each ball on the table straight into each pocket.

Geometry alone, from an observation; nothing is simulated. Where the cue ball must touch a target follows from how two
discs with friction part (`contacts`): the target leaves along the line of centres, thrown a little the way of the cut.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cuelearner_envs.billiards.contacts import TANGENT_PER_DISC
from cuelearner_envs.billiards.table import Table, corner_gap, pockets
from cuelearner_jax.environment import Aims
from cuelearner_jax.spaces.directions import difference, retract, rotate

THROWS = 8  # fixed-point steps for the line of centres: the throw depends on the cut, and the cut on the line
THINNEST = 0.15  # cosine of the thinnest cut that is tried
FARTHEST = 2.0  # clearances and misses are capped at this value
INWARD = 0.25  # a corner pocket is aimed at this share of its gap before the corner: its jaws stand out
EDGE = 20.0  # steepness of "there is room", per ball diameter or hole width


class TargetContact(NamedTuple):
    """The cue ball at the moment at which it touches a target."""

    place: Float[Array, "2"]  # of its centre [m]
    strike: Float[Array, "2"]  # direction of its way there
    normal: Float[Array, "2"]  # from its centre to the target's
    cut: Float[Array, ""]  # from the strike to the normal, counterclockwise [rad]


def aims_of(table: Table, obs: Float[Array, " obs"]) -> Aims:
    """Return the shot of every target into every pocket, targets first; see `Billiards.aims`."""
    balls = obs.reshape(-1, 3)
    targets, on_table = balls[1:, :2], balls[1:, 2] < 0
    places = pockets(table)
    corner = jnp.abs(places[:, :1]) > 0.0
    mouths = jnp.where(corner, places - INWARD * corner_gap(table) * jnp.sign(places), places)  # to aim at [m]
    openings = retract(jnp.where(corner, jnp.sign(places), places))  # straight through each pocket
    ball, pocket = (index.ravel() for index in jnp.indices((targets.shape[0], mouths.shape[0])))

    def one(ball: Int[Array, ""], pocket: Int[Array, ""]) -> Aims:
        contact = contact_for(table, balls[0, :2], targets[ball], retract(mouths[pocket] - targets[ball]))
        others = on_table & (jnp.arange(targets.shape[0]) != ball)
        features = _features(table, balls[0, :2], targets, ball, others, contact, mouths[pocket], openings[pocket])
        return Aims(contact.strike, features, on_table[ball] & (jnp.cos(contact.cut) > THINNEST))

    return jax.vmap(one)(ball, pocket)


def contact_for(
    table: Table, cue: Float[Array, "2"], target: Float[Array, "2"], way: Float[Array, "2"]
) -> TargetContact:
    """Return the contact at which the cue ball sends a target along `way` (a direction).

    Two discs with friction mu: the tangential impulse is the smaller of mu times the normal one and what ends the slip,
    so the target leaves along the normal turned toward the strike by atan(min(mu, tan(cut) / 6)).
    """

    def seen_along(normal: Float[Array, "2"]) -> TargetContact:
        place = target - 2.0 * table.ball_radius * normal
        strike = retract(place - cue)
        return TargetContact(place, strike, normal, difference(strike, normal))

    contact = seen_along(way)
    for _ in range(THROWS):
        slip = jnp.tan(jnp.minimum(jnp.abs(contact.cut), 1.5)) / (2.0 * TANGENT_PER_DISC)
        throw = jnp.arctan(jnp.minimum(table.friction, slip))  # from the line of centres to the target's way [rad]
        contact = seen_along(rotate(way, jnp.sign(contact.cut) * throw))
    return contact


def _features(
    table: Table,
    cue: Float[Array, "2"],
    targets: Float[Array, "targets 2"],
    ball: Int[Array, ""],
    others: Bool[Array, " targets"],
    contact: TargetContact,
    mouth: Float[Array, "2"],
    opening: Float[Array, "2"],
) -> Float[Array, "features"]:
    """Return features of a shot's difficulty, of the order of 1, equal for its mirror image."""
    radius, diameter = table.ball_radius, 2.0 * table.ball_radius
    way = mouth - targets[ball]
    far, near = jnp.linalg.norm(way), jnp.linalg.norm(contact.place - cue)
    cos = jnp.maximum(jnp.cos(contact.cut), THINNEST)
    gain = jnp.log((far / diameter) * (near / diameter + 0.1) / cos + 0.1)  # of an error of the aim, at the mouth
    margin = (table.hole_width * (opening * retract(way)).sum() - radius - table.cushion_radius) / radius
    ways = ((cue, contact.place), (targets[ball], mouth))
    apart = jnp.stack([_clearance(targets, others, *ends) for ends in ways]) / diameter
    apart = jnp.minimum(apart, FARTHEST)
    inside = jnp.stack([jnp.asarray(table.width), jnp.asarray(table.height)]) / 2.0 - radius - table.cushion_radius
    room = jnp.clip((inside - jnp.abs(contact.place)).min() / radius, -1.0, 1.0)
    miss, travel = _afterwards(table, contact)
    height = jnp.asarray(table.height)
    plain = [jnp.abs(contact.cut), cos, near / height, far / height, gain - 3.0, jnp.maximum(margin, -1.0), room]
    scratch = jax.nn.sigmoid(6.0 * (1.0 - miss)) * (travel > 0.1)
    return jnp.stack([*plain, *(apart - 1.0), *jax.nn.sigmoid(EDGE * (apart - 1.0)), miss - 1.0, travel, scratch])


def _clearance(
    targets: Float[Array, "targets 2"],
    others: Bool[Array, " targets"],
    start: Float[Array, "2"],
    end: Float[Array, "2"],
) -> Float[Array, ""]:
    """Return the distance of the closest other ball's centre from a ball's path [m]."""
    way = end - start
    share = jnp.clip(((targets - start[None]) @ way) / jnp.maximum((way * way).sum(), 1e-12), 0.0, 1.0)
    distance = jnp.linalg.norm(targets - start[None] - share[:, None] * way[None], axis=-1)
    return jnp.where(others, distance, jnp.inf).min()


def _afterwards(table: Table, contact: TargetContact) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the cue ball's miss of the nearest pocket ahead [hole widths] and its roll after the contact.

    All of its speed along the normal goes to the target (equal discs, elastic); it leaves along the tangent. What it
    rolls is given in table heights.
    """
    along, across = jnp.cos(contact.cut), jnp.abs(jnp.sin(contact.cut))
    remains = across - jnp.minimum(table.friction * along, across / (2.0 * TANGENT_PER_DISC))
    tangent = retract(contact.strike - along * contact.normal)
    to = pockets(table) - contact.place[None]
    beside = jnp.abs(to[:, 0] * tangent[1] - to[:, 1] * tangent[0])
    miss = jnp.where(to @ tangent > 0.0, beside, jnp.inf).min() / table.hole_width
    travel = remains * table.strike_speed / -jnp.log(table.speed_kept) / table.height
    return jnp.minimum(miss, FARTHEST), travel
