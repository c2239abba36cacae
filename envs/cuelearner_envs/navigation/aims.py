"""The ways that somebody may have in mind who sees a scan: directions all round, and how far the body could walk there.

Geometry alone, from an observation. What a beam hits is a point; a disc that walks in a direction is stopped by the
points within its radius of the line (the scan in configuration space: Lozano-Perez, 1983). Directions are counted from
the goal's, so that it is one of them, and each sees its neighbours: a doorway's edge is where the way beside it ends.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_envs.navigation.geometry import free_path
from cuelearner_envs.navigation.lidar import BEAM_ANGLES, BEAMS, MAX_RANGE
from cuelearner_envs.navigation.look_ahead import EVERY, look_ahead
from cuelearner_envs.navigation.world import FAR_AWAY
from cuelearner_envs.navigation.worlds import FARTHEST
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


def aims_of(obs: Float[Array, " obs"], ahead: bool = False) -> Aims:
    """The ways of a situation; see `Navigation.aims`.

    With `ahead` the last three features tell where two legs lead (`look_ahead.look_ahead`).
    """
    goal, away = obs[BEAMS : BEAMS + 2], obs[BEAMS + 2] * FARTHEST
    ways = rotate(jnp.broadcast_to(goal, (WAYS, 2)), jnp.arange(WAYS) * (2 * jnp.pi / WAYS))
    free = free_ways(obs, ways)
    seen = jnp.abs(to_angle(ways)) <= -BEAM_ANGLES[0] + math.radians(0.5)
    near = jnp.where(seen[None], jnp.exp(-free), UNSEEN)
    beside = [jnp.roll(near, -step, axis=1) for step in BESIDE]
    previous = obs[BEAMS + 3 : BEAMS + 9].reshape(-1, 2)
    rows = [*_lengths(ways, free[1], goal, away), *_seen_from(ways, goal[None]), *_seen_from(ways, previous)]
    rows += [jnp.full(WAYS, away / SCALE), ways[:, 0], ways[:, 1], seen.astype(jnp.float32)]
    if ahead:
        left, detour, leg = look_ahead(points_of(obs)[::EVERY], ways, free[2], away * goal, RADII[2])
        rows += [left / SCALE, jnp.clip(detour / SCALE, 0.0, 3.0), leg / SCALE]
    features = jnp.concatenate([row.reshape(-1, WAYS) for row in [*beside, *rows]]).T
    room = (free[0] > ROOM[0]) & (free[1] > ROOM[1]) & seen
    return Aims(ways, features, jnp.ones(WAYS, bool), room)


def free_ways(obs: Float[Array, " obs"], ways: Float[Array, "n 2"]) -> Float[Array, "radii n"]:
    """Return how far a disc of each radius can go in directions before it touches what the lidar sees [m], to 10 m."""
    points = points_of(obs)
    along = ways[:, :1] * points[None, :, 0] + ways[:, 1:] * points[None, :, 1]
    across = ways[:, :1] * points[None, :, 1] - ways[:, 1:] * points[None, :, 0]
    return jnp.stack([free_path(along, across, radius, MAX_RANGE) for radius in RADII])


def points_of(obs: Float[Array, " obs"]) -> Float[Array, "271 2"]:
    """Return each beam's hit in the body's frame [m]; `FAR_AWAY` without a hit."""
    ranges = -jnp.log(jnp.maximum(obs[:BEAMS], math.exp(-MAX_RANGE)))
    hit = ranges < MAX_RANGE - 0.01
    return jnp.where(hit[:, None], ranges[:, None] * from_angle(jnp.asarray(BEAM_ANGLES)), FAR_AWAY)


def _lengths(
    ways: Float[Array, "ways 2"], free: Float[Array, " ways"], goal: Float[Array, "2"], away: Float[Array, ""]
) -> list[Float[Array, " ways"]]:
    """Return each way's length as a detour: to its end or past its neighbours' obstacle, then straight to the goal."""
    end = jnp.minimum(free, away)
    corners = [jnp.minimum(jnp.minimum(jnp.roll(free, side), jnp.roll(free, 2 * side)), end) for side in (-1, 1)]

    def left(length: Float[Array, " ways"]) -> Float[Array, " ways"]:
        return jnp.linalg.norm(length[:, None] * ways - (away * goal)[None], axis=-1)

    detours = [jnp.clip((length + left(length) - away) / SCALE, 0.0, 3.0) for length in (end, *corners)]
    return [*detours, left(end) / SCALE, jnp.clip(free - away, -1.0, 1.0), free / SCALE]


def _seen_from(ways: Float[Array, "ways 2"], vectors: Float[Array, "n 2"]) -> list[Float[Array, "n ways"]]:
    """Rotate vectors into the frame of the ways: along and across."""
    x, y = vectors[:, :1], vectors[:, 1:]
    return [x * ways[None, :, 0] + y * ways[None, :, 1], y * ways[None, :, 0] - x * ways[None, :, 1]]
