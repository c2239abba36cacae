"""Billiards scenes and compiled functions that several test files share."""

import jax
import jax.numpy as jnp

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.environment import Balls
from cuelearner_jax.spaces import directions

EASY = make_environment(BilliardsConfig("easy"))
KEY = jax.random.key(0)
BATCH = 300  # size of every batch, so that each function compiles once
step_many = jax.jit(lambda env, keys, states, actions: jax.vmap(env.step)(keys, states, actions))
reset_many = jax.jit(lambda env, keys: jax.vmap(env.reset)(keys))
observe = jax.jit(lambda env, balls: env.observe(balls))
observe_many = jax.jit(lambda env, balls: jax.vmap(env.observe)(balls))


def balls(positions, pocketed=(False, False, False, False), shots=0):
    return Balls(jnp.array(positions, jnp.float32), jnp.array(pocketed), jnp.array(shots, jnp.int32))


def toward(degrees):
    return directions.from_angle(jnp.deg2rad(jnp.array(degrees, jnp.float32)))


SCENE = balls([(-0.2, 0.0), (0.1, -0.1), (0.3, 0.1), (0.0, 0.1)])


def random_states():
    """States of play, in three of four one target (of any number) has been taken off; half the strikes hit a ball."""
    states, _ = reset_many(EASY, jax.random.split(jax.random.key(5), BATCH))
    for number in range(3):
        key = jax.random.fold_in(KEY, number)
        states, _ = step_many(EASY, jax.random.split(key, BATCH), states, directions.uniform(key, (BATCH,)))
    ball = jnp.arange(4)[None]
    states = states.replace(pocketed=states.pocketed | ((jnp.arange(BATCH)[:, None] % 4 == ball) & (ball > 0)))
    closest = jax.jit(jax.vmap(EASY.heuristic))(observe_many(EASY, states))
    strikes = jnp.where(jnp.arange(BATCH)[:, None] % 8 < 4, closest, directions.uniform(jax.random.key(6), (BATCH,)))
    return states, strikes
