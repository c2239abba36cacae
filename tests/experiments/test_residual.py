"""Residual learning from optimal actions, on the bandit turned by a constant, through the program of adaptation."""

import _residual as residual
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from flax import struct

from cuelearner_jax.adaptation.lanes import Adaptation, ask_round, begin, product, rounds
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.guides.fitting import lessons
from cuelearner_jax.policies import Common
from cuelearner_jax.spaces import DIRECTIONS, directions
from cuelearner_jax.types import Label

TURN_DEG, BOUND_DEG = 8.0, 12.0
ENV = probes.Window(offset=0.6 + np.deg2rad(TURN_DEG))
SIZES = GuideSizes(feedback_layers=(32, 32), labels_per_round=10, fit_steps=300, fit_batch_size=32)
SCALARS = Scalars(eps_deg=BOUND_DEG, tau_max_deg=BOUND_DEG, k_max=10, feedback_learning_rate=5e-3, max_grad_norm=10.0)
GUIDANCE = residual.KIND.make(SIZES, spaces_of(ENV))
OBS = directions.evenly_spaced(4)


@struct.dataclass
class Finished:
    """Aims where the window was before the world changed."""

    def act(self, key, states, obs):
        return jax.vmap(probes.Window().best)(obs)


def asked(budget, bound_deg):
    """Lanes of a budget and bound after all of their rounds."""
    lanes = product(bases=1, seeds=(0, 1), budgets=(budget,), bounds_deg=(bound_deg,))
    of = Adaptation(GUIDANCE, SIZES, SCALARS, ENV, Common(Finished()))
    block = begin(of, lanes)
    for _ in range(rounds(lanes, SIZES)):
        block = ask_round(of, probes.Expert(ENV), block)
    return block, of.policy(block)


@pytest.fixture(scope="module")
def adapted():
    return asked(40, BOUND_DEG)


@pytest.mark.long
def test_a_constant_shift_is_recovered(adapted):
    _, policy = adapted
    for lane in range(2):
        done = policy.lane(lane).act(jax.random.key(0), None, OBS)
        off = np.rad2deg(DIRECTIONS.distance(done, jax.vmap(ENV.best)(OBS)))
        assert off.max() < TURN_DEG / 4


def test_targets_are_the_needed_corrections_cut_off():
    """From the direction x to 5 and to 90 degrees counterclockwise, at 12 degrees and in units of these."""
    shown = directions.from_angle(jnp.deg2rad(jnp.array([5.0, 90.0])))
    x = jnp.tile(jnp.array([[1.0, 0.0]]), (2, 1))
    rows = lessons(Label(OBS[:2], x, shown, jnp.ones(2, bool)), GUIDANCE.target, SCALARS)
    wanted = directions.from_angle(jnp.deg2rad(jnp.array([5.0, 12.0]))) - x
    np.testing.assert_allclose(rows.target, wanted, atol=1e-6)


def test_nothing_moves_before_the_first_fit():
    model = GUIDANCE.init(jax.random.key(0))
    moved = GUIDANCE.act(model, ENV, OBS, OBS, jnp.ones(4, bool), SCALARS)
    np.testing.assert_array_equal(moved.actions, OBS)
