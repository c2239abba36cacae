"""A second critic compares the guide's action with the agent's: whose is executed, and what the critic learns."""

import jax
import jax.numpy as jnp
import numpy as np
import probes

from cuelearner_jax import loop
from cuelearner_jax.arbiters import by_value
from cuelearner_jax.arbiters.protocol import Chooses, Finishes, HasCritic, LaneParts
from cuelearner_jax.guides import registry
from cuelearner_jax.runs.program import make_program
from cuelearner_jax.spaces import directions

OBS = directions.evenly_spaced(6)
ARBITER = by_value.Config().make(False)


class Fond:
    """An agent whose values are how far actions lie the way of its parameters."""

    def value(self, env, params, obs, actions):
        return jnp.sum(actions * params[None], -1)


def executed(critic, arbitrated, learns=True):
    env = probes.Window()
    guide = registry.make("heuristic", probes.SIZES, env)  # a turn by -1 rad
    state = by_value.ComparingState(jnp.asarray(arbitrated), critic)
    known = LaneParts(env, Fond(), -critic, guide, guide.init(jax.random.key(0)), probes.SCALARS, jnp.float32(0))
    return ARBITER.choose(state, by_value.Config(), known, OBS, OBS, jnp.array(learns), jax.random.key(0))


def test_the_guides_action_is_executed_where_the_second_critic_prefers_it():
    east = jnp.array([1.0, 0.0])
    refined = executed(east, [True] * 6)
    turned = np.asarray(directions.rotate(OBS, jnp.asarray(-1.0)))
    better = turned[:, 0] > np.asarray(OBS)[:, 0]
    assert 0 < better.sum() < 6
    np.testing.assert_allclose(refined.actions, np.where(better[:, None], turned, OBS), atol=1e-6)
    np.testing.assert_array_equal(refined.passes, better.astype(int))
    # The agent's own values, here the opposite, have no say.
    none = executed(east, [False] * 6)
    np.testing.assert_array_equal(none.actions, OBS)
    np.testing.assert_array_equal(executed(east, [True] * 6, learns=False).actions, OBS)


def test_it_is_what_the_protocols_ask_and_leaves_the_finished_policy_to_the_agent():
    assert isinstance(ARBITER, Chooses)
    assert isinstance(ARBITER, HasCritic)
    assert not isinstance(ARBITER, Finishes)


def test_the_second_critic_learns_the_same_values_from_other_parameters_and_batches():
    config = probes.config(arbiter=by_value.Config(), schedule={"random_steps": 400, "guidance_until": 10**6})
    env = probes.Window()
    program = make_program(config, registry.make("heuristic", config.sizes, env), env, 0)
    state = probes.start(program, [0], [0])
    before = probes.lane((state.agent.params, state.arbiter.params), 0)
    assert not all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, before), strict=True))
    _, state, metrics = program.train(env, config.settings, loop.start_clock(), state, 250)
    own, other = probes.lane((state.agent.params, state.arbiter.params), 0)
    assert not all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (own, other)), strict=True))
    obs = directions.evenly_spaced(4)
    for params in (own, other):  # 1 inside the window, 0 outside
        values = jax.vmap(lambda obs, p=params: probes.FUNCTIONS.value(env, p, obs, jnp.stack([env.best(obs), -obs])))
        np.testing.assert_allclose(values(obs), np.tile([1.0, 0.0], (4, 1)), atol=0.3)
    # The heuristic is never right here, and is hardly executed once the critic knows.
    assert float(metrics["guided_share"][0]) < 0.35
