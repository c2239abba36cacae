"""Another engine's shots in our environment. The engine of these tests moves every ball a little along x."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.billiards.environment import Balls
from cuelearner_envs.billiards.foreign import ForeignBilliards, Played
from cuelearner_envs.billiards.table import parking

OWN = make_environment(BilliardsConfig("regulation"))
PLACES = np.array([[-0.2, 0.0], [0.1, 0.0], [0.2, 0.1], [0.2, -0.1]], np.float32)


class Still(NamedTuple):
    """Moves every ball along x, and pockets the first target where the strike points to the right."""

    moved: float = 0.01  # of every ball along x [m]

    def __call__(self, positions, pocketed, angles):
        out = pocketed.copy()
        out[:, 1] |= np.cos(angles) > 0
        many = len(angles)
        rests = positions + np.array([self.moved, 0.0])
        return Played(rests, out, np.full(many, 2.0), np.full(many, 3), np.zeros(many, bool))


def env_of(engine):
    return ForeignBilliards(table=OWN.table, engine=engine, processes=1)


def test_the_engine_decides_where_balls_rest_and_pocketed_ones_stand_beside_the_table():
    state = Balls(jnp.asarray(PLACES), jnp.array([False, False, True, False]), jnp.zeros((), jnp.int32))
    angles = jnp.array([[0.0, 3.0], [0.5, 2.5]])  # any leading axes
    shots = jax.jit(jax.vmap(jax.vmap(lambda angle: env_of(Still()).shot(state, angle))))(angles)
    np.testing.assert_array_equal(shots.pocketed[..., 1], [[True, False], [True, False]])
    np.testing.assert_array_equal(shots.pocketed[..., 2], True)  # from before
    np.testing.assert_allclose(shots.positions[0, 1, :2], PLACES[:2] + np.array([0.01, 0.0]), rtol=1e-6)
    np.testing.assert_allclose(shots.positions[0, 0, 1], parking(OWN.table)[1])
    assert shots.duration.shape == (2, 2)
    assert float(shots.duration[0, 0]) == 2.0


def test_a_step_is_scored_by_the_rules_of_the_task():
    state = Balls(jnp.asarray(PLACES), jnp.zeros(4, bool), jnp.zeros((), jnp.int32))
    right, left = jnp.array([1.0, 0.0]), jnp.array([-1.0, 0.0])
    earned = jax.jit(lambda action: env_of(Still()).step(jax.random.key(0), state, action)[1].reward)
    assert [float(earned(action)) for action in (right, left)] == [1.0, 0.0]
