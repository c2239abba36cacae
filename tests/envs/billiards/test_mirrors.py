"""What billiards offers beyond the protocol: its mirror images, its heuristic, a shot as the player sees it."""

import jax
import jax.numpy as jnp
import numpy as np
from billiards_scenes import BATCH, EASY, KEY, balls, observe, observe_many, random_states, step_many

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment

MIRRORED = make_environment(BilliardsConfig("easy", mirrors=True))
mirror = jax.jit(MIRRORED.mirror)
mirror_many = jax.jit(jax.vmap(MIRRORED.mirror, (None, 0, 0)))
features = jax.jit(EASY.features)
heuristic = jax.jit(EASY.heuristic)


def test_mirrored_shots_have_mirrored_results_on_a_level_table():
    assert make_environment(BilliardsConfig("easy", mirrors=True, acceleration=(0.0, 0.005))).symmetries == 1
    states, strikes = random_states()
    keys = jax.random.split(KEY, BATCH)
    obs = observe_many(EASY, states)
    plain = np.asarray(step_many(EASY, keys, states, strikes)[1].reward)
    assert plain[np.asarray(states.pocketed).any(1)].sum() > 10
    for which, signs in enumerate(jnp.array([(1, 1), (-1, 1), (1, -1), (-1, -1)])):
        image = states.replace(positions=states.positions * signs[None, None])
        mirrored_obs, mirrored_strikes = mirror_many(jnp.array(which), obs, strikes)
        np.testing.assert_allclose(mirrored_obs, observe_many(EASY, image), atol=1e-7)
        np.testing.assert_array_equal(mirrored_strikes, strikes * signs[None])
        # The angle of the mirrored strike is rounded elsewhere in float32, which may decide a grazing contact: allow 1
        # of 300. None differed in 48,000 shots; a wrong mirror changes dozens.
        assert (np.asarray(step_many(EASY, keys, image, mirrored_strikes)[1].reward) != plain).sum() <= 1
        back, vector = mirror_many(jnp.array(which), mirrored_obs, mirrored_strikes)
        np.testing.assert_allclose(back, obs, atol=1e-7)
        np.testing.assert_array_equal(vector, strikes)


PLAYED = balls([(0.1, 0.05), (0.1, 0.15), (0.3, 0.05), (0.0, 0.0)], (False, False, False, True))


def parts(obs, strike):
    """Cue ball (2,), targets as they are (3, 3), what hangs on the direction alone (6,), targets from there (3, 3)."""
    own, turned = features(obs, strike)
    return np.asarray(own[:2]), np.asarray(own[2:]).reshape(3, 3), turned[:6], np.asarray(turned[6:]).reshape(3, 3)


def test_features_give_the_balls_along_and_across_the_strike():
    cue, places, strike, offsets = parts(observe(EASY, PLAYED), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(cue, [0.25, 0.125], atol=1e-6)
    np.testing.assert_allclose(strike, [0.0, 1.0, 0.0, 0.125, 0.0, 0.25], atol=1e-6)
    np.testing.assert_allclose(places, [[0, 0, 0], [0.25, 0.375, 1.0], [0.75, 0.125, 1.0]], atol=1e-6)
    aside = [0.0, -0.5, np.arctan(-0.2 / 0.04)]  # the first is pocketed, the second straight ahead
    np.testing.assert_allclose(offsets, [[0, 0, 0], [0.25, 0.0, 0.0], aside], atol=1e-6)
