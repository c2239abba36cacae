"""The ways that aims are: laws of geometry."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import rooms

from cuelearner_envs.navigation.aims import ROOM, free_ways, points_of
from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.lidar import BEAM_ANGLES
from cuelearner_jax.spaces.directions import from_angle

WORLD = rooms.world(rooms.walls(12.0, 8.0), [[2.0, 0.0, 0.5]], (12.0, 8.0), [[-4.0, 0.0]], [[4.0, 0.0]], heights=1.5)
ENV = Navigation(worlds=jax.tree.map(lambda leaf: leaf[None], WORLD))
AHEAD = jnp.array([1.0, 0.0])


def test_a_disc_is_stopped_where_it_touches():
    """Before a wall at 3 m, and beside a post at 2 m that is 0.3 m off the line."""
    beams = from_angle(jnp.asarray(BEAM_ANGLES))
    wall = jnp.where(beams[:, 0] > 0.3, 3.0 / jnp.maximum(beams[:, 0], 0.3), 10.0)
    obs = jnp.concatenate([jnp.exp(-jnp.minimum(wall, 10.0)), jnp.zeros(9)])
    np.testing.assert_allclose(free_ways(points_of(obs), AHEAD[None])[:, 0], [2.72, 2.58, 2.45], atol=1e-3)
    post = jnp.full(271, 10.0).at[135 + 9].set(2.0)  # 9 degrees to the left
    obs = jnp.concatenate([jnp.exp(-post), jnp.zeros(9)])
    along, across = 2.0 * math.cos(math.radians(9)), 2.0 * math.sin(math.radians(9))
    stopped = [10.0, *(along - math.sqrt(radius**2 - across**2) for radius in (0.42, 0.55))]
    np.testing.assert_allclose(free_ways(points_of(obs), AHEAD[None])[:, 0], stopped, atol=1e-3)
    nothing = points_of(jnp.full(280, math.exp(-5.0)), max_range=5.0)  # of a lidar that sees 5 m
    assert free_ways(nothing, AHEAD[None]).min() == 10.0


def test_aims_are_ways_with_room_and_the_goal_comes_first():
    obs = jax.jit(jax.vmap(lambda key: ENV.reset(key)[1]))(jax.random.split(jax.random.key(3), 12))
    aims = jax.jit(jax.vmap(ENV.aims))(obs)
    np.testing.assert_allclose(aims.actions[:, 0], obs[:, 271:273], atol=1e-6)
    behind = np.abs(np.arctan2(aims.actions[..., 1], aims.actions[..., 0])) > math.radians(136)
    possible = np.asarray(aims.open)
    assert np.asarray(aims.possible).all()
    assert not possible[behind].any()
    assert np.asarray(jax.vmap(free_ways)(jax.vmap(points_of)(obs), aims.actions)[:, 0])[possible].min() > ROOM[0]
