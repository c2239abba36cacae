"""A teacher in place of a model of it: toward its best action, or toward the nearest that it holds for good."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from flax import struct

from cuelearner_jax.config import GuideScalars, Scalars
from cuelearner_jax.policies import Corrected, wanted_actions
from cuelearner_jax.spaces import DIRECTIONS, directions

OBS = directions.evenly_spaced(4)


class Straight(struct.PyTreeNode):
    """Aims along its observation."""

    def act(self, key, states, obs):
        return obs


class TwoShots(struct.PyTreeNode):
    """Its best shot lies 90 degrees to the left of the observation, another good one 10 degrees to the right."""

    def best_action(self, state, obs):
        return directions.rotate(obs, jnp.pi / 2)

    def nearest_good(self, state, obs, action, spread, share):
        near = directions.rotate(obs, jnp.deg2rad(-10.0))
        closer = DIRECTIONS.distance(action, near) < DIRECTIONS.distance(action, self.best_action(state, obs))
        return jnp.where(closer, near, self.best_action(state, obs))


@pytest.mark.parametrize(
    ("answer", "bound_deg", "turned_deg"), [("best", 60, 60), ("nearest", 60, -10), ("nearest", 6, -6)]
)
def test_a_teacher_corrects_toward_what_it_has_in_mind_within_the_bound(answer, bound_deg, turned_deg):
    scalars = Scalars(answer=answer, eps_deg=2.0, tau_deg=0.1, tau_max_deg=float(bound_deg), k_max=50)
    policy = Corrected(Straight(), TwoShots(), scalars)
    done = policy.act(jax.random.key(0), OBS, OBS)
    np.testing.assert_allclose(np.rad2deg(directions.difference(OBS, done)), turned_deg, atol=1.0)


def test_scalars_without_a_teachers_part_mean_its_best():
    names = {field.name for field in dataclasses.fields(GuideScalars)}
    scalars = GuideScalars(**{name: getattr(probes.SCALARS, name) for name in names})
    wanted = wanted_actions(DIRECTIONS, TwoShots(), OBS, OBS, OBS, scalars)
    np.testing.assert_allclose(wanted, directions.rotate(OBS, jnp.pi / 2), atol=1e-6)
