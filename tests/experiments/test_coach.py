"""Deep COACH as a correction: it begins at nothing, and labels turn it, through the program of adaptation."""

import _coach as coach
import _energy as energy
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.adaptation.judging import judged_by_labels
from cuelearner_jax.adaptation.lanes import Adaptation, ask_round, begin, product, rounds
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.policies import Common
from cuelearner_jax.spaces import DIRECTIONS, directions
from cuelearner_jax.types import Label

TURN_DEG, BOUND_DEG = 8.0, 12.0
ENV = probes.Window(offset=0.6 + np.deg2rad(TURN_DEG))
SIZES = GuideSizes(feedback_layers=(32, 32), labels_per_round=10, fit_steps=300, fit_batch_size=32)
SCALARS = Scalars(eps_deg=2.0, tau_deg=0.2, tau_max_deg=BOUND_DEG, feedback_learning_rate=3e-3, max_grad_norm=10.0)
GUIDANCE = coach.KIND.make(SIZES, spaces_of(ENV), coach.KIND.config())
OBS = directions.evenly_spaced(4)


class Finished:
    """Aims where the window was before the world changed."""

    def act(self, key, states, obs):
        return jax.vmap(probes.Window().best)(obs)


jax.tree_util.register_pytree_node(Finished, lambda policy: ((), None), lambda _, leaves: Finished())


def test_a_correction_begins_at_nothing():
    params = GUIDANCE.init(jax.random.key(0)).params.policy
    np.testing.assert_array_equal(GUIDANCE.predict(ENV, params, OBS, OBS), OBS)


def test_lessons_are_seen_from_the_base_and_ask_for_the_action_told_about_turned_by_eps():
    away = directions.rotate(OBS, jnp.deg2rad(5.0))
    labels = Label(OBS, away, jnp.ones((4, 1)), jnp.ones(4, bool), base=OBS)
    rows = GUIDANCE.lessons(labels, SCALARS)
    np.testing.assert_array_equal(rows.action, OBS)
    np.testing.assert_allclose(rows.target, directions.rotate(OBS, jnp.deg2rad(7.0)), atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("kind", [coach.KIND, coach.BATCH, energy.KIND])
def test_labels_turn_a_finished_policy_and_held_out_ones_say_so(kind):
    guidance = kind.make(SIZES, spaces_of(ENV))
    lanes = product(bases=1, seeds=(0,), budgets=(60,), bounds_deg=(BOUND_DEG,))
    of = Adaptation(guidance, SIZES, SCALARS, ENV, Common(Finished()))
    block = begin(of, lanes)
    for _ in range(rounds(lanes, SIZES)):
        block = ask_round(of, probes.Expert(ENV), block)
    done = of.policy(block).lane(0).act(jax.random.key(0), None, OBS)
    off = np.rad2deg(DIRECTIONS.distance(done, jax.vmap(ENV.best)(OBS)))
    assert off.max() < TURN_DEG / 2
    assert judged_by_labels(of, block).used.all()
