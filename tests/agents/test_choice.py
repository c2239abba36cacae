"""The quick argmax against the full one: where it must agree, and what it may miss."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.agents import choice as search
from cuelearner_jax.agents import ddqn
from cuelearner_jax.agents.networks import as_function, q_network, widen_layers
from cuelearner_jax.devices import Portions
from cuelearner_jax.environment import Spaces
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import evenly_spaced, from_angle

LAYERS = (24, 24, 17)
FULL = ddqn.DDQNConfig(q_layers=LAYERS, directions=360)


def chosen(options, params, obs):
    """What an agent of five-number observations does while it learns."""
    return options.make("raw", Spaces(5, DIRECTIONS)).explore(None, options, params, obs, jax.random.key(0))


def agent(key=0, scale=3.0):
    """An agent whose values rise and fall several times round the circle."""
    params = q_network(LAYERS).init(jax.random.key(key), jnp.zeros(5), jnp.zeros(2))
    return jax.tree.map(lambda leaf: leaf * scale, params)


def bump(centre_deg, width_deg, height):
    """Values with one triangular peak."""

    def q(params, obs, actions):
        off = jnp.rad2deg(jnp.arccos(jnp.clip(actions @ from_angle(jnp.deg2rad(centre_deg)), -1, 1)))
        return (height * jnp.maximum(0.0, 1.0 - off / width_deg))[..., None]

    return q


def chosen_deg(q, peaks=2, coarse=36, n=360):
    value = lambda obs, actions: q(None, obs, actions)[:, 0]  # noqa: E731
    ((x, y),) = search.best_near_peaks(value, value, evenly_spaced(n), jnp.zeros((1, 1)), coarse, peaks)
    return float(jnp.rad2deg(jnp.arctan2(y, x)) % 360)


@pytest.mark.parametrize("centre", [3.0, 355.0])
def test_a_peak_between_two_directions_of_the_first_look_is_found(centre):
    assert chosen_deg(bump(centre, 12.0, 1.0)) == pytest.approx(centre, abs=0.01)


def test_the_higher_of_two_peaks_is_found_though_the_first_look_sees_it_lower():
    # At multiples of 10 degrees the broad peak shows 0.9, the narrow one (half-width 6, at 204) 2 * (1 - 4 / 6) = 0.67.
    broad, narrow = bump(90.0, 50.0, 0.9), bump(204.0, 6.0, 2.0)
    both = lambda *args: broad(*args) + narrow(*args)  # noqa: E731
    assert chosen_deg(both, peaks=2) == pytest.approx(204.0, abs=0.01)
    assert chosen_deg(both, peaks=1) == pytest.approx(90.0, abs=0.01)  # which one peak alone does not see


@pytest.mark.parametrize("coarse", probes.long_but([36], [36, 120, 360]))
def test_the_quick_choice_of_a_network_is_the_full_one(coarse):
    obs = jax.random.normal(jax.random.key(1), (64, 5))
    quick = dataclasses.replace(FULL, coarse_directions=coarse, peaks=4)
    fast, full = (chosen(options, agent(), obs) for options in (quick, FULL))
    assert len(np.unique(np.asarray(full), axis=0)) > 5  # choices differ from state to state
    np.testing.assert_array_equal(fast, full)


def test_a_first_look_in_bfloat16_gives_up_hardly_any_value():
    obs, params = jax.random.normal(jax.random.key(1), (64, 5)), agent()
    choices = chosen(dataclasses.replace(FULL, coarse_directions=60, coarse_dtype="bfloat16", peaks=4), params, obs)
    q = as_function(q_network(LAYERS))
    values = jax.vmap(lambda seen: q(params, seen, evenly_spaced(360))[:, 0])(obs)
    taken = jax.vmap(lambda seen, action: q(params, seen, action)[0])(obs, choices)
    given_up = (values.max(1) - taken) / (values.max(1) - values.mean(1))
    assert float(given_up.max()) < 0.02
    assert float(jnp.mean(given_up == 0)) > 0.9


def test_actions_by_chance_are_as_many_as_said_and_of_the_set():
    obs, params = jnp.zeros((2000, 5)), agent()
    actions = chosen(dataclasses.replace(FULL, exploration=0.3), params, obs)
    own = (actions == chosen(FULL, params, obs)).all(-1)
    assert float(own.mean()) == pytest.approx(0.7 + 0.3 / 360, abs=0.04)  # four standard errors
    assert float(jnp.abs(actions[:, None] - evenly_spaced(360)[None]).sum(-1).min(-1).max()) < 1e-6
    assert len(np.unique(np.asarray(actions[~own]), axis=0)) > 250


def test_actions_do_not_depend_on_how_many_states_are_searched_at_once(monkeypatch):
    obs = jax.random.normal(jax.random.key(2), (7, 5))
    together = chosen(FULL, agent(), obs)
    monkeypatch.setattr(search, "portions", lambda: Portions(actions=360, agents=1, states=1, passes=1))
    np.testing.assert_allclose(chosen(FULL, agent(), obs), together, atol=1e-6)


def test_units_that_fill_up_a_layer_add_exactly_nothing():
    params, obs = agent(), jax.random.normal(jax.random.key(3), (5,))
    wide, layers = widen_layers(params, LAYERS, 16)
    assert layers == (32, 32, 32)
    chex.assert_shape(wide["params"]["Dense_1"]["kernel"], (32, 32))
    options = evenly_spaced(8)
    before, after = (
        as_function(q_network(LAYERS))(params, obs, options),
        as_function(q_network(layers))(wide, obs, options),
    )
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-6)


def test_torch_layers_start_within_the_root_of_their_inputs():
    layers = q_network((300, 200)).clone(start="torch").init(jax.random.key(0), jnp.zeros(7), jnp.zeros(2))["params"]
    for layer, inputs in zip(layers.values(), (9, 300, 200), strict=True):
        for weights in layer.values():  # uniform within 1 / sqrt(inputs), biases too
            assert (0.95 if weights.size > 1 else 0) < float(jnp.abs(weights).max()) * inputs**0.5 <= 1
