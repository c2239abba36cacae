"""The walking robot obeys the laws it claims: a first-order lag, a bounded turn, and a body of three discs."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rooms import world
from scipy.integrate import solve_ivp

from cuelearner_envs.navigation.robot import Robot, collides, walk

step = jax.jit(walk)
step_many = jax.jit(jax.vmap(walk, (None, 0, 0, 0, None)))
touches = jax.jit(jax.vmap(collides, (None, None, 0)))


def toward(angle):
    return jnp.array([math.cos(angle), math.sin(angle)])


POST = world(circles=[[2.0, 1.0, 0.3]])


def test_a_step_is_what_a_general_integrator_finds():
    rng = np.random.default_rng(0)
    speed, heading = np.sqrt(rng.uniform(size=20)), rng.uniform(-np.pi, np.pi, 20)
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    pose = np.concatenate([rng.uniform(-5, 5, (20, 2)), rng.uniform(-np.pi, np.pi, (20, 1))], -1)
    angle = rng.uniform(-np.pi, np.pi, 20)
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    own = (jnp.asarray(rows, jnp.float32) for rows in (pose, velocity, direction))
    poses, velocities = step_many(Robot(speed=0.8, lag=0.15), *own, 0.3)
    for number in range(20):
        heading = pose[number, 2] + angle[number]  # held in the world's frame from the beginning of the step
        wanted = 0.8 * np.array([math.cos(heading), math.sin(heading)])
        result = solve_ivp(
            lambda _, s, wanted=wanted: np.concatenate([s[2:], (wanted - s[2:]) / 0.15]),
            (0.0, 0.3), np.concatenate([pose[number, :2], velocity[number]]), rtol=1e-10, atol=1e-12,
        )  # fmt: skip
        np.testing.assert_allclose(poses[number, :2], result.y[:2, -1], atol=2e-6)
        np.testing.assert_allclose(velocities[number], result.y[2:, -1], atol=2e-6)


@pytest.mark.parametrize(
    ("angle", "turned"), [(0.0, 0.0), (0.2, 0.2), (-0.29, -0.29), (0.31, 0.3), (2.0, 0.3), (-3.0, -0.3)]
)
def test_the_body_turns_toward_the_direction_at_1_5_rad_a_second_at_most(angle, turned):
    pose, _ = step(Robot(), jnp.array([0.0, 0.0, 0.7]), jnp.zeros(2), toward(angle), 0.2)
    assert float(pose[2]) == pytest.approx(0.7 + turned, abs=1e-6)


@pytest.mark.parametrize(
    ("pose", "contact"),
    # A post of radius 0.3 at (2, 1): ahead the body ends 0.465 m from its centre, beside it 0.265 m.
    [
        ([2.0 - 0.3 - 0.464, 1.0, 0.0], True),
        ([2.0 - 0.3 - 0.466, 1.0, 0.0], False),
        ([2.0, 1.0 - 0.3 - 0.264, 0.0], True),
        ([2.0, 1.0 - 0.3 - 0.266, 0.0], False),
        ([2.0, 1.0 - 0.3 - 0.464, math.pi / 2], True),
        ([2.0, 1.0 - 0.3 - 0.466, math.pi / 2], False),
        ([2.0, 1.0, 0.3], True),
    ],
)
def test_the_body_collides_with_a_post_to_the_millimetre(pose, contact):
    assert bool(touches(Robot(), POST, jnp.array([pose]))[0]) == contact


def test_outside_the_walls_counts_as_a_collision():
    poses = jnp.array([[-4.99, 0.0, 0.0], [-5.01, 0.0, 0.0], [0.0, 4.99, 0.0], [0.0, 5.01, 0.0], [20.0, 0.0, 0.0]])
    np.testing.assert_array_equal(touches(Robot(), world(extent=(10.0, 10.0)), poses), [False, True, False, True, True])
