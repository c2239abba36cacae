"""What networks see from an action: the same of situations that differ by a turn."""

import jax
import jax.numpy as jnp
import numpy as np
import probes

from cuelearner_jax.agents import ddqn, networks
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import Features, spaces_of
from cuelearner_jax.guides.fitting import guide_model
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces import directions as geometry

ENV = probes.Window()
OBS = geometry.from_angle(jnp.array([0.3, -2.0, 1.1]))
CHOSEN = geometry.from_angle(jnp.array([1.0, 0.5, -3.0]))
SIZES = GuideSizes(frame="action", feedback_layers=(16, 16))


class Turned(probes.Window):
    """The bandit seen from the action alone: nothing tells where the table's own axes point."""

    def features(self, obs, action):
        return Features(jnp.zeros(1), geometry.inward(jnp.broadcast_to(obs, action.shape), action))


def test_rows_are_seen_each_from_its_own_action():
    own, turned = networks.network_inputs("action", DIRECTIONS, ENV, OBS, CHOSEN)
    for row in range(3):
        alone = ENV.features(OBS[row], CHOSEN[row])
        np.testing.assert_allclose(own[row], alone.own, atol=1e-6)
        np.testing.assert_allclose(turned[row], alone.turned, atol=1e-6)
    assert networks.widths("action", spaces_of(ENV)) == (2, 4)


def test_a_vector_goes_outward_as_it_came_inward():
    np.testing.assert_allclose(geometry.outward(jnp.array([2.0, 1.0]), jnp.array([0.0, 1.0])), [-1.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(geometry.outward(geometry.inward(OBS, CHOSEN), CHOSEN), OBS, atol=1e-6)
    ahead = geometry.inward(geometry.rotate(CHOSEN, 0.2), CHOSEN)
    np.testing.assert_allclose(ahead, np.tile([np.cos(0.2), np.sin(0.2)], (3, 1)), atol=1e-6)


def test_what_a_guide_says_turns_with_the_situation():
    env, turn = Turned(), 0.7
    model = guide_model(SIZES, spaces_of(env))
    params = model.init(jax.random.key(0))
    before = model.predict(env, params, OBS, CHOSEN)
    after = model.predict(env, params, geometry.rotate(OBS, turn), geometry.rotate(CHOSEN, turn))
    np.testing.assert_allclose(after, geometry.rotate(before, turn), atol=1e-5)
    assert float(jnp.abs(before).max()) > 0.01
    numbers = guide_model(SIZES, spaces_of(env), 3)
    assert numbers.predict(env, numbers.init(jax.random.key(0)), OBS, CHOSEN).shape == (3, 3)


def test_the_greedy_choice_turns_with_the_situation():
    env, options = Turned(), ddqn.DDQNConfig(q_layers=(16,), directions=72, coarse_directions=12, peaks=12)
    agent = options.make("action", spaces_of(env))
    params, _ = agent.init(jax.random.key(3))
    choose = jax.jit(lambda obs: agent.explore(env, options, params, obs, jax.random.key(0)))
    turn = 7 * np.pi / 36  # as far as seven of the directions
    chosen = choose(OBS)
    np.testing.assert_allclose(choose(geometry.rotate(OBS, turn)), geometry.rotate(chosen, turn), atol=1e-5)
    directions = geometry.evenly_spaced(72)
    best = jax.vmap(lambda obs: agent.value(env, params, obs, directions).max())(OBS)
    np.testing.assert_allclose(agent.value(env, params, OBS, chosen), best, atol=1e-6)
