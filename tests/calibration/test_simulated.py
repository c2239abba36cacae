"""A change of the physics is compensated by what the simulator shows, and no change changes nothing."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from cuelearner_jax.calibration.families import Unknown
from cuelearner_jax.calibration.meaning import Meaning
from cuelearner_jax.calibration.policy import Calibrated
from cuelearner_jax.calibration.simulator import simulator_distortion
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import policy_of
from cuelearner_jax.spaces import DIRECTIONS, Box
from cuelearner_jax.spaces.directions import difference, from_angle, rotate
from cuelearner_jax.types import Step

WIDE = 0.02  # of the window that earns [rad]


class Windy(struct.PyTreeNode):
    """One shot at an angle; the wind turns what is shot by an amount that depends on where it stands."""

    wind: Any = 0.0

    def step(self, key, state, action):
        """Pays 1 within the window round the angle of the state."""
        flown = rotate(action, self.wind * (1 + state))
        hit = jnp.abs(difference(flown, from_angle(state))) < WIDE
        nothing = jnp.zeros(())
        return state, Step(nothing, nothing, nothing, hit.astype(jnp.float32), nothing, nothing, {}, {})


POLICY = policy_of(lambda obs: np.asarray(from_angle(obs[:, 0]), np.float32))
UNKNOWN = (Unknown("wind", "rad"),)


def windy(reach=6.0, space: Any = DIRECTIONS, tried=61, aim=None):
    env_of = lambda theta: Windy(theta[0])  # noqa: E731
    return simulator_distortion("wind", UNKNOWN, env_of, lambda obs: obs[0], space, reach, tried, aim)


# within two of the steps between tries; with an aim, also within what is as good as the best
@pytest.mark.parametrize(("aim", "near"), [(None, 0.004), (0.5, 0.008)])
@pytest.mark.parametrize("wind", [0.0, 0.03, -0.02])
def test_the_action_to_give_earns_what_the_meant_one_did(wind, aim, near):
    obs = jnp.linspace(0.0, 1.0, 5)[:, None]
    corrected = Calibrated(POLICY, jnp.array([wind]), (windy(aim=aim),))
    key = jax.random.key(0)
    turned = difference(POLICY.act(key, None, obs), corrected.act(key, None, obs))
    np.testing.assert_allclose(turned, -wind * (1 + obs[:, 0]), atol=near)
    if wind == 0:
        np.testing.assert_array_equal(turned, 0)


def test_a_policy_that_sees_no_change_is_asked_once_in_each_situation():
    asked = []

    def counted(obs):
        asked.append(len(obs))
        return np.asarray(from_angle(obs[:, 0]), np.float32)

    meaning = Meaning(policy_of(counted), DIRECTIONS)
    obs = np.linspace(0.0, 1.0, 5, dtype=np.float32)[:, None]
    first: list[int] = []
    for winds in ([0.0, 0.03], [-0.02]):
        found = meaning.actions((windy(),), np.array(winds)[:, None], obs)
        for wind, actions in zip(winds, found, strict=True):
            behind = Calibrated(POLICY, jnp.array([wind]), (windy(),)).act(jax.random.key(0), None, jnp.asarray(obs))
            np.testing.assert_allclose(actions, behind, atol=1e-6)
        first = first or list(asked)
    assert asked == first


def test_several_cues_and_even_numbers_are_refused():
    with pytest.raises(UserError, match="one cue"):
        windy(space=Box((0.0, 0.0), (1.0, 1.0)))
    with pytest.raises(UserError, match="odd"):
        windy(tried=12)
