"""How likely guides call actions: densities that integrate to one, laws of one pass, controls without labels."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.guides import aims, intent, registry, scalar
from cuelearner_jax.spaces import DIRECTIONS, Box, directions
from cuelearner_jax.types import GuidanceModel

ENV, OBS = probes.Aimed(), jnp.array([1.0, 0.0])
CIRCLE = directions.evenly_spaced(3600)
SCALARS = probes.SCALARS


def made(kind, env=ENV, options=None):
    bundle = registry.make(kind, probes.SIZES, env, options)
    return bundle, bundle.init(jax.random.key(0))


def test_the_density_round_aims_is_a_density():
    goals = directions.from_angle(jnp.array([0.3, -2.0]))
    found = np.exp(aims.log_density(DIRECTIONS, goals, jnp.array([0.6, 0.3, 0.1]), CIRCLE))
    assert found.mean() == pytest.approx(1.0, abs=1e-3)  # of a density that is 1 where all directions are alike
    near = np.asarray(DIRECTIONS.distance(CIRCLE, goals[:1])) < math.radians(10)
    assert found[near].sum() / 3600 == pytest.approx(0.6 + 0.1 * 20 / 360, abs=2e-3)
    # On the aim: 0.6 times the height of a logistic density of width 1 deg, 360 deg / 4, beside what means none.
    peak = aims.log_density(DIRECTIONS, goals, jnp.array([0.6, 0.3, 0.1]), goals[:1])
    np.testing.assert_allclose(np.exp(peak), [0.6 * 90.0 + 0.1], rtol=1e-4)


def test_no_action_is_ruled_out_by_aims_alone():
    goals = directions.from_angle(jnp.array([0.3]))
    far = aims.log_density(DIRECTIONS, goals, jnp.array([0.9, 0.1]), directions.from_angle(jnp.array([[3.0]]))[0])
    np.testing.assert_allclose(far, np.log(0.1), atol=1e-5)


@pytest.mark.parametrize("kind", ["any_aim", "intent"])
def test_before_the_first_label_intent_is_its_control(kind):
    bundle, model = made(kind)
    found = bundle.log_p(model, ENV, OBS, ENV.aims(OBS).actions, SCALARS)
    # Three possible aims and "none" alike; the impossible one is as likely as anything else.
    np.testing.assert_allclose(np.exp(found), [22.75, 22.75, 22.75, 0.25], rtol=1e-3)
    actions, possible = bundle.candidates(ENV, OBS)
    np.testing.assert_array_equal(actions, ENV.aims(OBS).actions)
    assert possible.tolist() == [True, True, True, False]


def test_what_is_not_open_is_no_candidate():
    class Shut(probes.Aimed):
        def aims(self, obs):
            return super().aims(obs)._replace(open=jnp.array([True, False, True, True]))

    for kind in ("any_aim", "rule", "intent"):
        bundle, model = made(kind, Shut())
        assert bundle.candidates(Shut(), OBS).possible.tolist() == [True, False, True, False]
        found = np.asarray(bundle.log_p(model, Shut(), OBS, ENV.aims(OBS).actions, SCALARS))
        assert found[1] < 0.0 < found[0]


def test_the_rule_is_followed_where_an_aim_is_possible():
    bundle, model = made("rule")
    found = np.asarray(bundle.log_p(model, ENV, OBS, ENV.aims(OBS).actions, SCALARS))
    share = np.exp(-2.0 * np.array([1.0, 0.6, 2.5]))
    np.testing.assert_allclose(np.exp(found[:3]), (90.0 * share + 1.0) / (share.sum() + 1.0), rtol=1e-3)
    rows, base = jnp.stack([OBS, -OBS]), directions.rotate(jnp.stack([OBS, -OBS]), jnp.array([2.0, -2.0]))
    acted = bundle.act(model, ENV, rows, base, jnp.array([True, False]), SCALARS)
    np.testing.assert_allclose(acted.actions[0], ENV.best(OBS), atol=1e-6)
    np.testing.assert_array_equal(acted.actions[1], base[1])
    assert acted.passes.tolist() == [1, 0]


def test_any_aim_leads_to_the_nearest():
    bundle, model = made("any_aim")
    base = directions.rotate(OBS[None], jnp.array([-0.7]))
    np.testing.assert_allclose(
        bundle.act(model, ENV, OBS[None], base, jnp.ones(1, bool), SCALARS).actions,
        directions.rotate(OBS[None], jnp.array([-1.0])),
        atol=1e-6,
    )


def test_without_labels_all_actions_are_alike_to_other_kinds():
    for kind in ("none", "relative", "demonstration", "dcoach", "scalar", "bdcoach", "clic"):
        bundle, model = made(kind)
        assert bundle.candidates(ENV, OBS) is None
        assert not np.asarray(bundle.log_p(model, ENV, OBS, CIRCLE[:50], SCALARS)).any(), kind


def test_a_turn_by_eps_costs_one():
    """The heuristic turns every action to -1 rad: log p falls by 1 for each eps that an action is away."""
    bundle, model = made("heuristic")
    turns = jnp.array([-1.0, -1.0 + math.radians(20.0), -1.0 - math.radians(50.0)])
    found = bundle.log_p(model, ENV, OBS, directions.rotate(jnp.broadcast_to(OBS, (3, 2)), turns), SCALARS)
    np.testing.assert_allclose(found, [0.0, -1.0, -2.5], atol=1e-4)


def test_of_relative_one_pass_counts_however_many_follow():
    bundle, model = made("relative")
    model = model.replace(fitted=jnp.array(True))
    actions = CIRCLE[::100]
    obs = jnp.broadcast_to(OBS, actions.shape)
    once = dataclasses.replace(SCALARS, k_max=1)
    moved = bundle.act(model, ENV, obs, actions, jnp.ones(36, bool), once).actions
    wanted = -np.degrees(DIRECTIONS.distance(actions, moved)) / SCALARS.eps_deg
    np.testing.assert_allclose(bundle.log_p(model, ENV, OBS, actions, SCALARS), wanted, atol=1e-5)
    assert wanted.min() < wanted.max() <= 0.0


def test_scalar_says_how_likely_an_action_is_called_good():
    bundle, model = made("scalar", options=scalar.Config(guide_directions=36))
    model = GuidanceModel(model.params, jnp.array(True))
    predicted = bundle.network.predict(ENV, model.params, OBS, CIRCLE[::100])[:, 0]
    found = bundle.log_p(model, ENV, OBS, CIRCLE[::100], SCALARS)
    np.testing.assert_allclose(np.exp(found), np.clip(predicted, 0.01, 1.0), rtol=1e-5)


def test_aims_of_a_box_lie_along_every_cue():
    box = Box((0.0, 0.0), (1.0, 2.0))
    goals = jnp.array([[0.5, 1.0]])
    grid = jnp.stack(jnp.meshgrid(jnp.linspace(0, 1, 401), jnp.linspace(0, 2, 401)), -1).reshape(-1, 2)
    found = np.exp(aims.log_density(box, goals, jnp.array([1.0, 0.0]), grid))
    assert found.argmax() == len(grid) // 2
    assert found.mean() == pytest.approx(1.0, rel=0.05)
    assert intent.SPREAD == aims.SPREAD
