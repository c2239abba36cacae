"""A shot, from strike to rest, event by event.

Drag is linear and the same for every ball, so time can be warped, s(t) = (1 - exp(-lambda t)) / lambda with
lambda = -ln(speed_kept): in s every ball flies straight at constant speed u = v exp(lambda t). The next contact is then
the root of a quadratic, and impulses, being homogeneous in velocity, act on u as they do on v. A constant acceleration
enters as kicks between flights (leapfrog), in slices so short that a flight bends by less than `BEND`; without it there
are none.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from cuelearner_envs.billiards.contacts import (
    RIM_PER_IMPULSE,
    Each,
    next_on_edge,
    normal_impulse,
    tangential_impulse,
    time_to_circle,
)
from cuelearner_envs.billiards.table import Scalar, Table, as_arrays, parking

Places = Float[ArrayLike, "balls 2"]  # [m]
Flags = Bool[ArrayLike, "balls"]
Angle = Float[ArrayLike, ""]  # [rad]
BLOCK = 4096  # shots that `simulate_many` simulates at once
BEND = 1e-5  # largest departure of a flight between two kicks from the true parabola [m]


@struct.dataclass
class Shot:
    """Outcome of a shot."""

    positions: Float[Array, "balls 2"]  # at rest; pocketed balls stand beside the table [m]
    pocketed: Bool[Array, "balls"]  # now, those from before the shot included
    duration: Float[Array, ""]  # until the slowest-stopping ball is slower than the table's stop speed [s]
    events: Int[Array, ""]  # impacts, pocketings and kicks, the stop included
    exhausted: Bool[Array, ""]  # the table's max_events were reached first: the balls were halted where they were


@struct.dataclass
class Trajectory:
    """A shot between its events, for drawing: from each knot on, balls fly straight in warped time."""

    times: Float[Array, "knots"]  # [s]; knots = max_events + 1, the last one repeated once the shot is over
    positions: Float[Array, "knots balls 2"]  # [m]
    velocities: Float[Array, "knots balls 2"]  # per unit of warped time [m/s]
    pocketed: Bool[Array, "knots balls"]


class ShotState(NamedTuple):
    """State of a shot between two events. Velocities are per unit of warped time."""

    x: Float[Array, "balls"]  # [m]
    y: Float[Array, "balls"]  # [m]
    ux: Float[Array, "balls"]  # [m/s]
    uy: Float[Array, "balls"]  # [m/s]
    rim: Float[Array, "balls"]  # spin as speed of the rim, counterclockwise positive [m/s]
    pocketed: Bool[Array, "balls"]
    warped: Float[Array, ""]  # warped time since the strike [s]
    kicks: Int[Array, ""]  # since the strike
    events: Int[Array, ""]
    is_over: Bool[Array, ""]


class Contact(NamedTuple):
    """The earliest contact of all balls. Ball a meets ball b, or alone a cushion or a pocket."""

    wait: Float[Array, ""]  # warped time until then; infinite if there is none [s]
    a: Bool[Array, "balls"]  # one-hot
    b: Bool[Array, "balls"]  # one-hot, or none
    centre_x: Float[Array, ""]  # of the cushion's centre line where a touches it, if it is alone [m]
    centre_y: Float[Array, ""]  # [m]
    falls: Bool[Array, ""]  # a drops into a pocket


def drag(table: Table) -> Float[Array, ""]:
    """Rate of exponential decay of all velocities [1/s]."""
    return -jnp.log(table.speed_kept)


def warp(rate: Float[Array, ""], time: Each) -> Each:
    """Return the warped time at a time since the strike: the distance covered meanwhile per unit of initial speed."""
    return jnp.where(rate > 0.0, -jnp.expm1(-rate * time) / jnp.where(rate > 0.0, rate, 1.0), time)


def unwarp(rate: Float[Array, ""], warped: Each) -> Each:
    """Time since the strike at a warped time."""
    return jnp.where(rate > 0.0, -jnp.log1p(-rate * warped) / jnp.where(rate > 0.0, rate, 1.0), warped)


def kick(rate: Float[Array, ""], start: Each, end: Each) -> Each:
    """Gain of u per unit of acceleration between two warped times: the integral of exp(lambda t) dt."""
    return (end - start) / ((1.0 - rate * start) * (1.0 - rate * end))


def slice_length(table: Table) -> Float[Array, ""]:
    """Time between kicks: a parabola of this length rises by `BEND` over its chord [s]. Of no meaning without tilt."""
    strength = jnp.hypot(table.acceleration[0], table.acceleration[1])
    return jnp.where(strength > 0.0, jnp.sqrt(8.0 * BEND / jnp.where(strength > 0.0, strength, 1.0)), 1.0)


def next_contact(table: Table, motion: ShotState) -> Contact:
    """The earliest among all contacts of balls with each other and with the table's edge."""
    n, out = table.balls, motion.pocketed
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    first, second = (lambda v: jnp.stack([v[i] for i, _ in pairs])), (lambda v: jnp.stack([v[j] for _, j in pairs]))
    gap, speed = (lambda v: second(v) - first(v)), (lambda v: second(v) - first(v))
    between = time_to_circle(gap(motion.x), gap(motion.y), speed(motion.ux), speed(motion.uy), 2.0 * table.ball_radius)
    between = jnp.where(first(out) | second(out), jnp.inf, between)
    edge = next_on_edge(table, motion.x, motion.y, motion.ux, motion.uy)
    alone = jnp.where(out, jnp.inf, edge.time)

    # A code i * n + j per candidate, i == j for a ball alone. Two plain minima: faster on a CPU than argmin.
    waits = jnp.concatenate([between, alone])
    codes = jnp.asarray([i * n + j for i, j in pairs] + [i * n + i for i in range(n)])
    wait = jnp.min(waits)
    code = jnp.min(jnp.where(waits == wait, codes, n * n))
    ball = jnp.arange(n)
    a, b = ball == code // n, (ball == code % n) & (code // n != code % n)
    return Contact(wait, a, b, of(edge.centre_x, a), of(edge.centre_y, a), jnp.any(edge.falls & a) & ~jnp.any(b))


def time_to_stop(table: Table, motion: ShotState, unseen: Scalar) -> Float[Array, ""]:
    """Return the warped time until every ball is slower than the stop speed; exact if no ball changes direction.

    Along its direction a ball obeys dv/dt = a - lambda v, `unseen` being the kick due since the last one applied.
    """
    rate, rest = drag(table), 1.0 - drag(table) * motion.warped
    gx, gy = table.acceleration[0], table.acceleration[1]
    vx, vy = (motion.ux + gx * unseen) * rest, (motion.uy + gy * unseen) * rest
    speed = jnp.sqrt(vx * vx + vy * vy)
    fast = ~motion.pocketed & (speed > table.stop_speed)
    along = (gx * vx + gy * vy) / jnp.where(fast, speed, 1.0)
    slows = rate * table.stop_speed > along  # else the tilt keeps it faster for ever
    wait = rest * (speed - table.stop_speed) / jnp.where(fast & slows, rate * speed - along, 1.0)
    return jnp.max(jnp.where(fast, jnp.where(slows, wait, jnp.inf), 0.0))


def of(value: Float[Array, "balls"], ball: Bool[Array, "balls"]) -> Float[Array, ""]:
    """The value of the one ball marked, 0 if none is. A masked sum: cheaper than a gather on any vector unit."""
    return jnp.sum(jnp.where(ball, value, 0.0))


def impact(table: Table, motion: ShotState, contact: Contact, unseen: Scalar) -> ShotState:
    """Apply the impulses of a contact that is now, between balls a and b or between a and a cushion."""
    a, b, paired = contact.a, contact.b, jnp.any(contact.b)
    discs = jnp.where(paired, 2.0, 1.0)
    away_x = of(motion.x, a) - jnp.where(paired, of(motion.x, b), contact.centre_x)
    away_y = of(motion.y, a) - jnp.where(paired, of(motion.y, b), contact.centre_y)
    length = jnp.sqrt(away_x * away_x + away_y * away_y)
    nx, ny = away_x / jnp.where(length > 0.0, length, 1.0), away_y / jnp.where(length > 0.0, length, 1.0)

    vx, vy = of(motion.ux, a) - of(motion.ux, b), of(motion.uy, a) - of(motion.uy, b)
    # A kick that is due acts on both balls of a pair alike, so only a cushion feels it.
    late_x = jnp.where(paired, 0.0, table.acceleration[0] * unseen)
    late_y = jnp.where(paired, 0.0, table.acceleration[1] * unseen)
    jn = normal_impulse(-(vx * nx + vy * ny), -(late_x * nx + late_y * ny), table.restitution, discs)
    slip = (vy + late_y) * nx - (vx + late_x) * ny - of(motion.rim, a) - of(motion.rim, b)
    jt = tangential_impulse(slip, jn, table.friction, discs)

    sign = a.astype(vx.dtype) - b.astype(vx.dtype)
    return motion._replace(
        ux=motion.ux + sign * (jn * nx - jt * ny),
        uy=motion.uy + sign * (jn * ny + jt * nx),
        rim=motion.rim + jnp.where(a | b, RIM_PER_IMPULSE * jt, 0.0),
    )


def step(table: Table, motion: ShotState) -> ShotState:
    """Fly to the next event and apply it: a contact, a kick or the stop. Nothing changes once the shot is over."""
    rate, slice_ = drag(table), slice_length(table)
    gx, gy = table.acceleration[0], table.acceleration[1]
    tilted = (gx != 0.0) | (gy != 0.0)
    active = ~motion.is_over
    middle = warp(rate, (motion.kicks + 0.5) * slice_)  # where u is the true velocity

    contact = next_contact(table, motion)
    until_kick = jnp.maximum(warp(rate, (motion.kicks + 1) * slice_) - motion.warped, 0.0)
    until_kick = jnp.where(tilted, until_kick, jnp.inf)
    until_stop = time_to_stop(table, motion, kick(rate, middle, motion.warped))
    wait = jnp.minimum(contact.wait, jnp.minimum(until_kick, until_stop))
    wait = jnp.where(~active | jnp.isinf(wait), 0.0, wait)
    stops = active & (until_stop <= jnp.minimum(contact.wait, until_kick))
    kicks = active & ~stops & (until_kick <= contact.wait) & tilted
    touches = active & ~stops & ~kicks & (contact.wait < jnp.inf)

    now = motion.warped + wait
    after = motion._replace(x=motion.x + motion.ux * wait, y=motion.y + motion.uy * wait, warped=now)
    falling = contact.a & touches & contact.falls
    contact = contact._replace(a=contact.a & touches & ~contact.falls, b=contact.b & touches)
    hit = impact(table, after, contact, kick(rate, middle, now))

    gain = jnp.where(kicks, kick(rate, middle, warp(rate, (motion.kicks + 1.5) * slice_)), 0.0)
    pocketed = motion.pocketed | falling
    flying = ~pocketed & ~stops
    place_x, place_y = parking(table).T
    return ShotState(
        x=jnp.where(falling, place_x, hit.x),
        y=jnp.where(falling, place_y, hit.y),
        ux=jnp.where(flying, hit.ux + gx * gain, 0.0),
        uy=jnp.where(flying, hit.uy + gy * gain, 0.0),
        rim=jnp.where(flying, hit.rim, 0.0),
        pocketed=pocketed,
        warped=now,
        kicks=motion.kicks + kicks,
        events=motion.events + active,
        is_over=motion.is_over | stops,
    )


def strike(table: Table, positions: Places, pocketed: Flags, angle: Angle) -> tuple[Table, ShotState]:
    """Return the table in the dtype of `positions`, and the cue ball leaving it without spin in the direction `angle`.

    Every ball has had the first half kick.
    """
    positions = jnp.asarray(positions)
    table, pocketed = as_arrays(table, positions.dtype), jnp.asarray(pocketed, bool)
    angle = jnp.asarray(angle, positions.dtype)
    rest, zero = jnp.zeros_like(positions[:, 0]), jnp.zeros_like(angle)
    struck = jnp.arange(table.balls) == 0
    half = kick(drag(table), zero, warp(drag(table), slice_length(table) / 2))
    gx, gy = table.acceleration[0] * half, table.acceleration[1] * half
    place_x, place_y = parking(table).T
    count = jnp.zeros((), jnp.int32)
    return table, ShotState(
        x=jnp.where(pocketed, place_x, positions[:, 0]),
        y=jnp.where(pocketed, place_y, positions[:, 1]),
        ux=jnp.where(pocketed, 0.0, gx + jnp.where(struck, table.strike_speed * jnp.cos(angle), 0.0)),
        uy=jnp.where(pocketed, 0.0, gy + jnp.where(struck, table.strike_speed * jnp.sin(angle), 0.0)),
        rim=rest,
        pocketed=pocketed,
        warped=zero,
        kicks=count,
        events=count,
        is_over=jnp.zeros((), bool),
    )


def simulate(table: Table, positions: Places, pocketed: Flags, angle: Angle) -> Shot:
    """Play one shot: strike the cue ball in the direction `angle` [rad] and wait until all balls rest.

    Pure; `jit` and `vmap` at will (the batch may include the table). Computes in the dtype of `positions` [m].
    """
    table, start = strike(table, positions, pocketed, angle)
    motion = jax.lax.while_loop(
        lambda motion: ~motion.is_over & (motion.events < table.max_events), partial(step, table), start
    )
    return Shot(
        positions=jnp.stack([motion.x, motion.y], axis=-1),
        pocketed=motion.pocketed,
        duration=unwarp(drag(table), motion.warped),
        events=motion.events,
        exhausted=~motion.is_over,
    )


def simulate_many(
    table: Table,
    positions: Float[Array | np.ndarray, "shots balls 2"],
    pocketed: Bool[Array | np.ndarray, "shots balls"],
    angles: Float[Array | np.ndarray, "shots"],
) -> Shot:
    """`vmap(simulate)` in blocks: working memory stays in cache, and a long shot holds up only its block.

    Every field of the result leads with (shots,).
    """
    shots, block = len(angles), min(BLOCK, len(angles))
    rows = np.minimum(np.arange(-(-shots // block) * block), shots - 1)  # the last block is filled up
    scene = jax.tree.map(lambda leaf: jnp.asarray(leaf)[rows], (positions, pocketed, angles))
    result = jax.lax.map(lambda one: simulate(table, *one), scene, batch_size=block)
    return jax.tree.map(lambda leaf: leaf[:shots], result)


def trace(table: Table, positions: Places, pocketed: Flags, angle: Angle) -> Trajectory:
    """Simulate a shot as `simulate` does and keep every event, for drawing; always takes max_events steps."""
    table, start = strike(table, positions, pocketed, angle)

    def keep(motion: ShotState, _: None) -> tuple[ShotState, ShotState]:
        after = step(table, motion)
        return after, after

    _, after = jax.lax.scan(keep, start, None, length=table.max_events)
    knots = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, after)
    return Trajectory(
        times=unwarp(drag(table), knots.warped),
        positions=jnp.stack([knots.x, knots.y], axis=-1),
        velocities=jnp.stack([knots.ux, knots.uy], axis=-1),
        pocketed=knots.pocketed,
    )


def positions_at(
    table: Table, path: Trajectory, times: Float[ArrayLike, "times"]
) -> tuple[Float[Array, "times balls 2"], Bool[Array, "times balls"]]:
    """Return positions [m] and pocketed balls at given times since the strike [s]; at rest after the shot."""
    table = as_arrays(table, path.positions.dtype)
    times = jnp.clip(times, 0.0, path.times[-1])
    knot = jnp.clip(jnp.searchsorted(path.times, times, side="right") - 1, 0)
    since = warp(drag(table), times) - warp(drag(table), path.times[knot])
    return path.positions[knot] + path.velocities[knot] * since[:, None, None], path.pocketed[knot]
