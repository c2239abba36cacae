"""The ways that somebody may have in mind who sees a scan: directions all round, and how far the body could walk there.

Geometry alone, from an observation. What a beam hits is a point; a disc that walks in a direction is stopped by the
points within its radius of the line (the scan in configuration space: Lozano-Perez, 1983). Directions are counted from
the goal's, so that it is one of them, and each sees its neighbours: a doorway's edge is where the way beside it ends.

How far a body could walk along a way says nothing of what comes after the corner. With look-ahead a disc walks two
straight legs, the second toward the goal or turned from it. What the lidar has not seen counts as free: the free-space
assumption of robots in unknown terrain (Koenig, Smirnov, "Sensor-based planning with the freespace assumption", 1997).

Cost: 7 stations on each of 72 ways, 5 second legs from each, every second of 271 points: 340,000 tests of a disc
against a point for an observation, where the ways themselves take 60,000.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_envs.navigation.geometry import free_path, free_paths
from cuelearner_envs.navigation.lidar import BEAM_ANGLES, BEAMS, MAX_RANGE, Scalar
from cuelearner_envs.navigation.world import FAR_AWAY
from cuelearner_envs.navigation.worlds import FARTHEST
from cuelearner_jax.devices import goes_through
from cuelearner_jax.environment import Aims
from cuelearner_jax.spaces.directions import from_angle, rotate, to_angle

WAYS = 72  # every 5 degrees
RADII = (0.28, 0.42, 0.55)  # of the discs: the body's own, nearly its reach, and what a road map keeps clear [m]
BESIDE = (0, 1, -1, 2, -2, 4, -4, 8, -8)  # neighbours that a way takes into account, in steps of 5 degrees
# A way on which the first two discs are stopped sooner is not open [m]: the body's front is 0.2 m ahead, a step is
# 0.2 m, and a body that turns needs more room than one that goes straight.
ROOM = (0.6, 0.1)
SCALE = 5.0  # of lengths among the features [m]
UNSEEN = -1.0  # nearness in directions that the lidar does not cover
EVERY = 2  # of the beams: second legs look at every second point, 0.17 m apart at 5 m
SHARES = (0.25, 0.5, 0.75, 1.0)  # of a way's free length, where stations lie
BEYOND = 0.9  # and this far past what stops the ways beside it: what a disc needs to get round a corner [m]
SHORT = 0.1  # stations keep this far from what ends their way: a disc that touches could not slide along it [m]
LEAST = 1.0  # a way is walked so far before the second leg, or as far as the goal is away [m]
# Second legs, turned from the goal's direction. One at 90 degrees comes no nearer to the goal, whatever is free.
TURNS_DEG = (0.0, 30.0, -30.0, 60.0, -60.0)
STEP = 0.2  # who cannot walk so far in a direction has no first leg there [m]
# A metre walked counts as so many that are left: of plans that end as near to the goal the shorter is looked at.
SHORTER = 0.05


def aims_of(obs: Float[Array, " obs"], ahead: bool = False, max_range: Scalar = MAX_RANGE) -> Aims:
    """The ways of a situation, seen by a lidar of a range [m]; see `Navigation.aims`.

    With `ahead` the last three features tell where two legs lead (`look_ahead`).
    """
    goal, away = obs[BEAMS : BEAMS + 2], obs[BEAMS + 2] * FARTHEST
    ways = rotate(jnp.broadcast_to(goal, (WAYS, 2)), jnp.arange(WAYS) * (2 * jnp.pi / WAYS))
    points = points_of(obs, max_range)
    free = free_ways(points, ways)
    visible = jnp.abs(to_angle(ways)) <= -BEAM_ANGLES[0] + math.radians(0.5)
    near = jnp.where(visible[None], jnp.exp(-free), UNSEEN)
    beside = [jnp.roll(near, -step, axis=1) for step in BESIDE]
    previous = obs[BEAMS + 3 : BEAMS + 9].reshape(-1, 2)
    rows = [*_lengths(ways, free[1], goal, away), *_seen_from(ways, goal[None]), *_seen_from(ways, previous)]
    rows += [jnp.full(WAYS, away / SCALE), ways[:, 0], ways[:, 1], visible.astype(jnp.float32)]
    if ahead:
        rest, detour, leg = look_ahead(points[::EVERY], ways, free[2], away * goal, RADII[2])
        rows += [rest / SCALE, jnp.clip(detour / SCALE, 0.0, 3.0), leg / SCALE]
    features = jnp.concatenate([row.reshape(-1, WAYS) for row in [*beside, *rows]]).T
    room = (free[0] > ROOM[0]) & (free[1] > ROOM[1]) & visible
    return Aims(ways, features, jnp.ones(WAYS, bool), room)


def free_ways(points: Float[Array, "points 2"], ways: Float[Array, "n 2"]) -> Float[Array, "radii n"]:
    """Return how far a disc of each radius can go in directions before it touches a point [m], to 10 m."""
    along = ways[:, :1] * points[None, :, 0] + ways[:, 1:] * points[None, :, 1]
    across = ways[:, :1] * points[None, :, 1] - ways[:, 1:] * points[None, :, 0]
    return jnp.stack([free_path(along, across, radius, MAX_RANGE) for radius in RADII])


def points_of(obs: Float[Array, " obs"], max_range: Scalar = MAX_RANGE) -> Float[Array, "271 2"]:
    """Return each beam's hit in the body's frame [m]; `FAR_AWAY` without a hit, which reads `max_range`."""
    ranges = -jnp.log(jnp.maximum(obs[:BEAMS], math.exp(-MAX_RANGE)))
    hit = ranges < jnp.minimum(max_range, MAX_RANGE) - 0.01
    return jnp.where(hit[:, None], ranges[:, None] * from_angle(jnp.asarray(BEAM_ANGLES)), FAR_AWAY)


def _lengths(
    ways: Float[Array, "ways 2"], free: Float[Array, " ways"], goal: Float[Array, "2"], away: Float[Array, ""]
) -> list[Float[Array, " ways"]]:
    """Return each way's length as a detour: to its end or past its neighbours' obstacle, then straight to the goal."""
    end = jnp.minimum(free, away)
    corners = [jnp.minimum(jnp.minimum(jnp.roll(free, side), jnp.roll(free, 2 * side)), end) for side in (-1, 1)]

    def rest(length: Float[Array, " ways"]) -> Float[Array, " ways"]:
        return jnp.linalg.norm(length[:, None] * ways - (away * goal)[None], axis=-1)

    detours = [jnp.clip((length + rest(length) - away) / SCALE, 0.0, 3.0) for length in (end, *corners)]
    return [*detours, rest(end) / SCALE, jnp.clip(free - away, -1.0, 1.0), free / SCALE]


def _seen_from(ways: Float[Array, "ways 2"], vectors: Float[Array, "n 2"]) -> list[Float[Array, "n ways"]]:
    """Rotate vectors into the frame of the ways: along and across."""
    x, y = vectors[:, :1], vectors[:, 1:]
    return [x * ways[None, :, 0] + y * ways[None, :, 1], y * ways[None, :, 0] - x * ways[None, :, 1]]


def look_ahead(
    points: Float[Array, "points 2"],
    ways: Float[Array, "ways 2"],
    free: Float[Array, " ways"],
    goal: Float[Array, "2"],
    radius: float,
) -> tuple[Float[Array, " ways"], Float[Array, " ways"], Float[Array, " ways"]]:
    """Return the remaining length to the goal after the best two legs, of which the first goes along each way.

    Lengths are metres in the body's frame. `points` are what beams hit, `ways` unit vectors all round in order, so that
    neighbours lie side by side; `free` is how far a disc of the radius can walk along each.

    Returns the straight distance that is left after both legs; the detour, both legs and what is left less the straight
    distance from here; the length of the first leg. Without room for a first leg: the distance from here, infinity, 0.
    """
    legs = _stations(ways, free, goal)
    second_legs = lambda leg: _second_legs(points, ways, leg, goal, radius)  # noqa: E731
    # Reductions take one station after the other: side by side they need three times the memory, and no less time.
    plans = jax.vmap(second_legs)(legs) if goes_through() else jax.lax.map(second_legs, legs)
    cost, rest, walked, leg = (values.reshape(-1, ways.shape[0]) for values in plans)
    is_least = cost <= cost.min(0, keepdims=True)  # more than one only where they are worth the same

    def of_least(values: Float[Array, "plans ways"]) -> Float[Array, " ways"]:
        return jnp.where(is_least, values, jnp.inf).min(0)

    away, room = jnp.linalg.norm(goal), free > STEP
    detour = jnp.where(room, of_least(walked + rest) - away, jnp.inf)
    return jnp.where(room, of_least(rest), away), detour, jnp.where(room, of_least(leg), 0.0)


def _stations(
    ways: Float[Array, "ways 2"], free: Float[Array, " ways"], goal: Float[Array, "2"]
) -> Float[Array, "stations ways"]:
    """Return the positions of stations along the ways [m]: even, past neighbours' obstacles, nearest the goal."""
    end = jnp.maximum(free - SHORT, 0.0)
    beside = [jnp.minimum(jnp.roll(free, side), jnp.roll(free, 2 * side)) + BEYOND for side in (-1, 1)]
    least = jnp.minimum(LEAST, jnp.linalg.norm(goal))
    nearest = jnp.maximum(ways[:, 0] * goal[0] + ways[:, 1] * goal[1], least)
    return jnp.stack([*(share * end for share in SHARES), *(jnp.minimum(length, end) for length in (*beside, nearest))])


def _second_legs(
    points: Float[Array, "points 2"],
    ways: Float[Array, "ways 2"],
    leg: Float[Array, " ways"],
    goal: Float[Array, "2"],
    radius: float,
) -> tuple[Float[Array, "turns ways"], ...]:
    """Every second leg after a first one of each way: what it is worth, what is left, what was walked, the first leg.

    A second leg ends where it comes nearest to the goal, or where the disc is stopped.
    """
    places = leg[:, None] * ways
    offset = goal[None] - places
    away = jnp.sqrt(jnp.maximum(jnp.sum(jnp.square(offset), -1), 1e-12))
    ahead = offset / away[:, None]
    features, turns = [], [math.radians(turn) for turn in TURNS_DEG]
    turned = jnp.stack([rotate(ahead, turn) for turn in turns])
    free = free_paths(turned, jnp.broadcast_to(places, turned.shape), points, radius, MAX_RANGE)
    for turn, length in zip(turns, free, strict=True):
        cos, sin = math.cos(turn), math.sin(turn)
        second = jnp.minimum(length, cos * away)
        rest = jnp.sqrt(jnp.square(away - second * cos) + jnp.square(second * sin))
        walked = leg + second
        features.append((rest + SHORTER * walked, rest, walked, leg))
    return tuple(jnp.stack(column) for column in zip(*features, strict=True))
