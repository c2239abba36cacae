"""Several steps of look-ahead: a way is walked to a station, and from there on past what the scan shows.

How far a body could walk along a way says nothing of what comes after the corner. Here a disc walks two straight legs,
the second toward the goal or turned from it. What the lidar has not seen counts as free: the free-space assumption of
robots in unknown terrain (Koenig, Smirnov, "Sensor-based planning with the freespace assumption", ICRA 1997).
Look-ahead uses one scan, in the body's frame, and remembers no former scan.

Cost: 7 stations on each of 72 ways, 5 second legs from each, every second of 271 points: 340,000 tests of a disc
against a point for an observation, where the ways themselves take 60,000.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cuelearner_envs.navigation.geometry import free_paths
from cuelearner_envs.navigation.lidar import MAX_RANGE
from cuelearner_jax.devices import goes_through
from cuelearner_jax.spaces.directions import rotate

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


def look_ahead(
    points: Float[Array, "points 2"],
    ways: Float[Array, "ways 2"],
    free: Float[Array, " ways"],
    goal: Float[Array, "2"],
    radius: float,
) -> tuple[Float[Array, " ways"], Float[Array, " ways"], Float[Array, " ways"]]:
    """Return the remaining length to the goal after the best two legs, of which the first goes along each way.

    Args:
        points: what beams hit, in the body's frame; those that hit nothing lie far away [m].
        ways: unit vectors all round in order, so that neighbours lie side by side.
        free: how far a disc of the radius can walk along each [m].
        goal: in the body's frame [m].
        radius: of the disc [m].

    Returns:
        the straight distance that is left after both legs [m]; the detour, both legs and what is left less the straight
        distance from here [m]; the length of the first leg [m]. Where there is no room for a first leg: the straight
        distance from here, infinity, 0.
    """
    legs = _stations(ways, free, goal)
    second_legs = lambda leg: _second_legs(points, ways, leg, goal, radius)  # noqa: E731
    # Reductions take one station after the other: side by side they need three times the memory, and no less time.
    plans = jax.vmap(second_legs)(legs) if goes_through() else jax.lax.map(second_legs, legs)
    cost, left, walked, leg = (values.reshape(-1, ways.shape[0]) for values in plans)
    chosen = cost <= cost.min(0, keepdims=True)  # more than one only where they are worth the same

    def of_chosen(values: Float[Array, "plans ways"]) -> Float[Array, " ways"]:
        return jnp.where(chosen, values, jnp.inf).min(0)

    away, room = jnp.linalg.norm(goal), free > STEP
    detour = jnp.where(room, of_chosen(walked + left) - away, jnp.inf)
    return jnp.where(room, of_chosen(left), away), detour, jnp.where(room, of_chosen(leg), 0.0)


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
    found, turns = [], [math.radians(turn) for turn in TURNS_DEG]
    turned = jnp.stack([rotate(ahead, turn) for turn in turns])
    free = free_paths(turned, jnp.broadcast_to(places, turned.shape), points, radius, MAX_RANGE)
    for turn, length in zip(turns, free, strict=True):
        cos, sin = math.cos(turn), math.sin(turn)
        second = jnp.minimum(length, cos * away)
        left = jnp.sqrt(jnp.square(away - second * cos) + jnp.square(second * sin))
        walked = leg + second
        found.append((left + SHORTER * walked, left, walked, leg))
    return tuple(jnp.stack(column) for column in zip(*found, strict=True))
