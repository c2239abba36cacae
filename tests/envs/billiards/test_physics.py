"""Billiards obeys the laws it claims: impulses, energy, drag, symmetry, tilt, and its own bookkeeping."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import to_segments
from scipy.integrate import solve_ivp

from cuelearner_envs.billiards import Table, physics, positions_at, simulate, trace
from cuelearner_envs.billiards.table import cushions, rack

RATE = -math.log(0.7)  # of the drag, lambda [1/s]

shoot = jax.jit(simulate)
shoot_many = jax.jit(jax.vmap(simulate, (None, 0, 0, 0)))
draw = jax.jit(trace)
look = jax.jit(positions_at)


def scattered(table, shots, seed=0):
    """Random places of all balls inside the cushions, none overlapping; every second shot is aimed at ball 1."""
    rng = np.random.default_rng(seed)
    half = np.array([table.width / 2, table.height / 2]) - table.ball_radius - table.cushion_radius
    places = rng.uniform(-half, half, (40 * shots, table.balls, 2))
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1) + np.eye(table.balls)
    places = places[apart.min((1, 2)) > 2 * table.ball_radius][:shots]
    assert len(places) == shots
    angles = rng.uniform(-np.pi, np.pi, shots)
    aim = np.arctan2(*(places[:, 1] - places[:, 0]).T[::-1]) + rng.uniform(-0.05, 0.05, shots)
    return places, np.where(np.arange(shots) % 2, aim, angles)


def play(table, places, angles, dtype=jnp.float32):
    """Outcome of many shots, as numpy arrays."""
    shot = shoot_many(table, jnp.asarray(places, dtype), jnp.zeros(places.shape[:2], bool), jnp.asarray(angles, dtype))
    return jax.tree.map(np.asarray, shot)


def play_one(table, places, angle):
    """Outcome of one shot with every ball on the table."""
    return jax.tree.map(np.asarray, shoot(table, jnp.asarray(places), jnp.zeros(len(places), bool), jnp.asarray(angle)))


LARGE = Table.one_ball().replace(width=6.0, height=3.0)


def random_collisions(table, count, seed=0):
    """Two touching balls in random motion and spin, and the contact between them."""
    rng = np.random.default_rng(seed)
    normal, r = rng.uniform(-np.pi, np.pi, count), float(table.ball_radius)
    a, n = rng.uniform(-0.1, 0.1, (count, 2)), np.stack([np.cos(normal), np.sin(normal)], -1)
    u = rng.normal(0, 0.4, (count, 2, 2))
    closing = ((u[:, 0] - u[:, 1]) * n).sum(-1)
    u = np.where((closing < 0)[:, None, None], u[:, ::-1], u)  # ball a approaches b
    x = np.stack([a, a + 2 * r * n], 1)
    zero = jnp.zeros(count)
    motion = physics.ShotState(
        *(jnp.asarray(v) for v in (x[..., 0], x[..., 1], u[..., 0], u[..., 1], rng.normal(0, 0.2, (count, 2)))),
        pocketed=jnp.zeros((count, 2), bool), warped=zero, kicks=zero, events=zero, is_over=zero > 0,
    )  # fmt: skip
    one, two = (jnp.broadcast_to(jnp.arange(2) == i, (count, 2)) for i in (0, 1))
    return motion, physics.Contact(zero, one, two, zero, zero, zero > 0), n


def totals(motion, radius):
    """Momentum (count, 2), angular momentum about the origin and energy of discs of mass 1."""
    x, y, ux, uy, rim = (np.asarray(v, float) for v in motion[:5])
    momentum = np.stack([ux.sum(-1), uy.sum(-1)], -1)
    return momentum, (x * uy - y * ux + 0.5 * radius * rim).sum(-1), (0.5 * (ux**2 + uy**2) + 0.25 * rim**2).sum(-1)


@pytest.mark.parametrize(("friction", "restitution"), [(0.0, 1.0), (0.25, 1.0), (0.25, 0.8), (50.0, 1.0)])
def test_collision_keeps_momentum_and_reverses_the_normal_speed(friction, restitution):
    table = Table.one_ball().replace(friction=friction, restitution=restitution)
    before, contact, n = random_collisions(table, 500)
    after = jax.vmap(physics.impact, (None, 0, 0, None))(table, before, contact, 0.0)
    (p0, l0, e0), (p1, l1, e1) = totals(before, table.ball_radius), totals(after, table.ball_radius)
    np.testing.assert_allclose(p1, p0, atol=1e-6)
    np.testing.assert_allclose(l1, l0, atol=1e-7)
    velocities = [np.stack([m.ux, m.uy], -1) for m in (before, after)]
    closing = [((u[:, 0] - u[:, 1]) * n).sum(-1) for u in velocities]
    firm = closing[0] > 2e-3  # softer impacts are elastic, whatever the restitution
    np.testing.assert_allclose(closing[1][firm], -restitution * closing[0][firm], atol=3e-6)
    if friction == 0.0:
        np.testing.assert_allclose(e1, e0, rtol=1e-5)
        np.testing.assert_array_equal(after.rim, before.rim)
    else:
        assert (e1 < e0 + 1e-7).all()
        assert (e1 < 0.99 * e0).mean() > 0.2
    if friction == 50.0:  # enough to end the slip: both rims move together at the contact
        along = n[:, 1] * (after.ux[:, 0] - after.ux[:, 1]) - n[:, 0] * (after.uy[:, 0] - after.uy[:, 1])
        assert (np.abs(along - after.rim.sum(-1)) < 2e-6).mean() > 0.9


def test_nothing_overlaps_at_rest_and_no_shot_runs_out_of_events():
    table = Table.regulation().replace(acceleration=(0.0, 0.005))
    places, angles = scattered(table, 1000)
    places[::4] = np.asarray(rack(table))
    shot = play(table, places, angles)
    assert not shot.exhausted.any()
    assert np.isfinite(shot.positions).all()
    apart = np.linalg.norm(shot.positions[:, :, None] - shot.positions[:, None], axis=-1) + np.eye(4)
    assert apart.min() > 2 * table.ball_radius - 2e-6
    on = shot.positions[~shot.pocketed]
    reach = table.ball_radius + table.cushion_radius
    assert to_segments(on[:, None], *np.moveaxis(np.asarray(cushions(table), float), 1, 0)).min() > reach - 2e-6
    assert (np.abs(on) <= np.array([table.width / 2, table.height / 2]) + table.pocket_margin).all()
    assert (np.linalg.norm(shot.positions - places, axis=-1) > 1e-4)[:, 1:].any(1).mean() > 0.5


def integrate(start, velocity, gravity, ceiling, until):
    """A ball under drag and acceleration that bounces off a cushion at y = ceiling, by a general integrator."""
    state, now, gravity = np.array([*start, *velocity], float), 0.0, np.asarray(gravity)

    def hits(_, s):
        return ceiling - s[1]

    hits.terminal, hits.direction = True, -1
    while True:
        motion = solve_ivp(
            lambda _, s: np.concatenate([s[2:], gravity - RATE * s[2:]]),
            (now, until), state, events=hits, rtol=1e-10, atol=1e-12,
        )  # fmt: skip
        state, now = motion.y[:, -1], motion.t[-1]
        if motion.status == 0:
            return state
        state[1], state[3] = ceiling - 1e-12, -state[3]


def test_tilted_flight_and_bounce_against_an_integrator():
    gravity, start = (0.002, 0.005), [[-1.0, 0.9], [1.0, 0.0]]
    table = LARGE.replace(friction=0.0, acceleration=gravity)
    shot = play_one(table, start, 0.8)
    ceiling, until = 1.5 - 0.024, float(shot.duration)
    cue = integrate(start[0], [0.5 * math.cos(0.8), 0.5 * math.sin(0.8)], gravity, ceiling, until)
    target = integrate(start[1], [0.0, 0.0], gravity, ceiling, until)
    assert cue[3] < 0.03  # it has bounced
    assert math.hypot(*cue[2:]) == pytest.approx(table.stop_speed, abs=1e-5)
    np.testing.assert_allclose(shot.positions, [cue[:2], target[:2]], atol=5e-5)
    assert target[1] > 0.05  # a ball at rest feels the tilt too


def test_trace_follows_simulate():
    table = Table.regulation().replace(acceleration=(0.0, 0.005))
    places, angles = scattered(table, 4, seed=3)
    for place, angle in zip(places, angles, strict=True):
        scene = jnp.asarray(place, jnp.float32), jnp.zeros(4, bool), jnp.asarray(angle, jnp.float32)
        shot, path = shoot(table, *scene), draw(table, *scene)
        assert path.times.shape == (table.max_events + 1,)
        assert (np.diff(path.times) >= 0).all()
        np.testing.assert_allclose(path.positions[-1], shot.positions, atol=1e-5)
        times = jnp.linspace(0.0, shot.duration + 1.0, 400)
        where, gone = look(table, path, times)
        np.testing.assert_allclose(where[0], place, atol=1e-6)
        np.testing.assert_allclose(where[-1], shot.positions, atol=1e-5)
        np.testing.assert_array_equal(gone[-1], shot.pocketed)
        strides = np.linalg.norm(np.diff(where, axis=0), axis=-1)[~np.diff(gone, axis=0)]
        assert strides.max() <= 0.55 * float(times[1] - times[0])  # no ball jumps, except into its parking place
