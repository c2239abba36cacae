"""Demonstrations, scalar feedback, preferences and deep COACH on the bandit whose best direction is known."""

import dataclasses
from functools import cache
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from scipy.stats import spearmanr

from cuelearner_jax import asking
from cuelearner_jax.guides import dcoach, registry, scalar
from cuelearner_jax.policies import Uniform
from cuelearner_jax.spaces import DIRECTIONS, UNSAID, Box, Cue, directions
from cuelearner_jax.types import Label

ENV = probes.Window()
SIZES = probes.SIZES
OPTIONS = dict.fromkeys(("scalar", "preference"), scalar.ScalarConfig(guide_directions=36))
SCALARS = dataclasses.replace(probes.SCALARS, scalar_within_deg=20.0)
OBS = directions.evenly_spaced(4)
BEST = jax.jit(jax.vmap(ENV.best))(OBS)
KEY = jax.random.key(3)


@cache
def compiled(kind, frame="raw"):
    """A kind's bundle, its `fit` and its `act`."""
    bundle = registry.make(kind, dataclasses.replace(SIZES, frame=frame), ENV, OPTIONS.get(kind))
    return bundle, jax.jit(bundle.fit), jax.jit(bundle.act)


def taught(kind, rounds, scalars=SCALARS, frame="raw"):
    """A guide after rounds of ten questions about its own choices, uniform actions before there is a model."""
    bundle = compiled(kind, frame)[0]
    label_round = probes.label_rounds(bundle, SIZES)
    guide = asking.start(bundle, ENV, 10 * rounds, 10 * rounds, jax.random.key(1), jax.random.key(2))
    for _ in range(rounds):
        guide = label_round(ENV, probes.Expert(ENV), scalars, Uniform(), guide, KEY)
    return guide


def errors(kind, model, base=BEST, scalars=SCALARS, frame="raw"):
    """Degrees from the best direction in each context, under guidance of base actions."""
    acted = compiled(kind, frame)[2](model, ENV, OBS, base, jnp.ones(4, bool), scalars).actions
    return np.degrees(DIRECTIONS.distance(BEST, acted))


def labels(answers, obs, asked):
    """Label sets all of whose rows count."""
    return Label(obs, asked, answers, jnp.ones(len(obs), bool))


def drawn(count):
    """Contexts and uniform actions."""
    k_context, k_action = jax.random.split(jax.random.key(7))
    return OBS[jax.random.randint(k_context, (count,), 0, 4)], directions.uniform(k_action, (count,))


@pytest.mark.parametrize(
    ("frame", "rounds", "within"), [("raw", 3, 2), pytest.param("action", 6, 10, marks=pytest.mark.long)]
)
def test_demonstrations_are_cloned_and_replace_whatever_the_agent_would_do(frame, rounds, within):
    guide = taught("demonstration", rounds, frame=frame)
    for base in (BEST, -BEST, directions.rotate(BEST, 1.0)):
        assert errors("demonstration", guide.model, base, frame=frame).max() < within
    asked = np.degrees(DIRECTIONS.distance(jax.vmap(ENV.best)(guide.labels.obs), guide.labels.action))
    assert asked[:10].max() > 60  # uniform
    assert np.median(asked[20:]) < 20  # about the policy itself, once there is one
    np.testing.assert_allclose(guide.labels.answer, jax.vmap(ENV.best)(guide.labels.obs), atol=1e-6)


def test_a_share_of_the_scalar_questions_explores():
    bundle, _, _ = compiled("scalar")
    model = bundle.init(KEY).replace(fitted=jnp.array(True))
    own = compiled("scalar")[2](model, ENV, OBS[:1], BEST[:1], jnp.ones(1, bool), SCALARS).actions[0]
    keys = jax.random.split(KEY, 400)
    for explored, refined in ((1.0, 1.0), (0.25, 0.5)):
        asks = dataclasses.replace(bundle, options=dataclasses.replace(bundle.options, explored_fraction=explored))
        scalars = dataclasses.replace(SCALARS, refined_fraction=refined)
        ask = jax.jit(jax.vmap(lambda key: asks.question(key, model, ENV, OBS[0], BEST[0], scalars)))  # noqa: B023
        about_own = (np.abs(np.asarray(ask(keys)) - np.asarray(own)).max(-1) < 1e-5).mean()
        assert about_own == pytest.approx((1 - explored) * refined, abs=0.08)  # standard deviation 0.025


def test_the_loss_of_a_preference_is_the_likelihood_of_bradley_and_terry(monkeypatch):
    """u is the first entry: u(b) - u(a) = 2, so P(b over a) = 1 / (1 + e^-2) = 0.8808; no difference: half of each."""
    bundle, _, _ = compiled("preference")
    utility = SimpleNamespace(predict=lambda env, params, obs, actions: params * actions[:, :1])
    monkeypatch.setitem(vars(bundle), "network", utility)
    a, b = jnp.tile(jnp.array([-1.0, 0.0]), (3, 1)), jnp.tile(jnp.array([1.0, 0.0]), (3, 1))
    rows = bundle.examples(labels(jnp.concatenate([jnp.array([[1.0], [-1.0], [0.0]]), b], -1), OBS[:3], a), SCALARS)
    losses = bundle.losses(ENV, SCALARS, jnp.array(1.0), rows)
    np.testing.assert_allclose(losses, [0.126928, 2.126928, 1.126928], rtol=1e-5)  # log(1 + e^-2), and 2 and 1 more
    slopes = jax.jacobian(lambda params: bundle.losses(ENV, SCALARS, params, rows))(jnp.array(1.0))
    np.testing.assert_allclose(slopes, [-0.238406, 1.761594, 0.761594], rtol=1e-5)  # (P - p) (u(b) - u(a))


def test_preferences_are_fitted_to_the_order_of_a_utility():
    """Utility: the cosine of the angle to the best direction; of actions that no label is about too."""
    bundle, fit, _ = compiled("preference")
    (obs, one), other = drawn(300), directions.uniform(jax.random.key(8), (300,))
    utility = lambda obs, actions: (jax.vmap(ENV.best)(obs) * actions).sum(-1)  # noqa: E731
    choices = jnp.sign(utility(obs, other) - utility(obs, one))[:, None]
    model = fit(KEY, ENV, labels(jnp.concatenate([choices, other], -1), obs, one), bundle.init(KEY), SCALARS)
    around = directions.evenly_spaced(36)
    for context in OBS:
        fits = bundle.network.predict(ENV, model.params, context, around)[:, 0]
        assert spearmanr(utility(jnp.tile(context, (36, 1)), around), fits).statistic > 0.95
    assert errors("preference", model).max() < 20


def corrections(count):
    """Corrections toward the best direction about uniform actions."""
    obs, asked = drawn(count)
    return labels(jnp.sign(DIRECTIONS.log(asked, jax.vmap(ENV.best)(obs))), obs, asked)


def first(count, given):
    """The same with so many rows that count."""
    return given.replace(valid=jnp.arange(len(given.valid)) < count)


def test_deep_coach_goes_on_from_where_it_was_by_what_is_new():
    bundle, fit, _ = compiled("dcoach")
    given, fresh = corrections(30), bundle.init(KEY)
    half = fit(KEY, ENV, first(10, given), fresh, SCALARS)
    assert int(half.params.learned) == 10
    chex.assert_trees_all_equal(fit(KEY, ENV, first(10, given), half, SCALARS), half)  # nothing is new
    at_once = fit(KEY, ENV, given, fresh, SCALARS)
    chex.assert_trees_all_equal(fit(KEY, ENV, given, half, SCALARS), at_once)
    other = half.replace(params=half.params.replace(policy=bundle.init(jax.random.key(9)).params.policy))
    assert not np.allclose(errors("dcoach", fit(KEY, ENV, given, other, SCALARS)), errors("dcoach", at_once), atol=0.1)


def test_answers_that_are_missing_are_no_corrections():
    bundle, fit, _ = compiled("dcoach")
    given, fresh = corrections(30), bundle.init(KEY)
    valid = jnp.arange(30) % 3 > 0
    gaps = fit(KEY, ENV, given.replace(valid=valid), fresh, SCALARS)
    assert int(gaps.params.learned) == 20
    order = np.argsort(~np.asarray(valid), kind="stable")
    moved = jax.tree.map(lambda leaf: leaf[order], given)
    chex.assert_trees_all_equal(gaps, fit(KEY, ENV, first(20, moved), fresh, SCALARS))
    assert not bool(fit(KEY, ENV, first(0, given), fresh, SCALARS).fitted)


@pytest.mark.parametrize(("kind", "silent"), [("relative", True), ("dcoach", False)])
def test_a_cue_that_one_label_names_is_silent_where_that_label_is_held_out(kind, silent):
    words = (("x", ("right", "left")), ("y", ("up", "down")))
    space = Box((-1.0,) * 2, (1.0,) * 2, tuple(Cue(name, both, (), "shares") for name, both in words))
    guide, answer = registry.make(kind, SIZES, SimpleNamespace(actions=space, obs_size=3)), np.tile([1, UNSAID], (5, 1))
    answer[4] = UNSAID, 1  # every fifth label is held out, by kinds that hold any
    rows = labels(jnp.float32(answer), jnp.zeros((5, 3)), jnp.zeros((5, 2)))
    cues = np.asarray(guide.examples(rows, dataclasses.replace(SCALARS, eps_deg=0.1)).cues)
    assert cues[:4].tolist() == [[True, silent]] * 4


@pytest.mark.parametrize("kind", ["relative", "clic"])
def test_entries_that_nobody_is_asked_about_stay_and_those_of_which_nothing_is_said_hardly_move(kind):
    words = {"x": ("right", "left"), "y": ("", ""), "z": ("up", "down")}
    space = Box((-1.0,) * 3, (1.0,) * 3, tuple(Cue(name, both, (), "shares") for name, both in words.items()))
    env, random = SimpleNamespace(actions=space, obs_size=3), np.random.default_rng(0)
    guide, obs = registry.make(kind, SIZES, env), random.uniform(-1, 1, (60, 3)).astype(np.float32)
    action = obs / 2  # the policy's own
    answer = np.stack([np.sign(obs[:, 0] - action[:, 0]), *np.full((2, 60), UNSAID)], -1).astype(np.float32)
    given, scalars = labels(*map(jnp.asarray, (answer, obs, action))), dataclasses.replace(SCALARS, eps_deg=0.1)
    model = guide.fit(KEY, env, given, guide.init(KEY), scalars)
    acted = guide.act_within(jnp.array(0.5), model, env, given.obs, given.action, given.valid, scalars).actions
    moved = np.abs(np.asarray(acted) - action).mean(0)
    assert moved[1] == 0
    assert 0 < moved[2] < 0.1 * moved[0]


def test_a_correction_moves_the_policy_its_way_by_eps(monkeypatch):
    bundle, _, act = compiled("dcoach")
    monkeypatch.setattr(dcoach, "CORRECTION_REPLAY", 1)
    fit = jax.jit(bundle.fit)
    model = bundle.init(KEY).replace(fitted=jnp.array(True))
    scalars = dataclasses.replace(SCALARS, feedback_learning_rate=1e-2)
    everywhere = jnp.ones(4, bool)
    for h in (1.0, -1.0, 0.0):
        own = act(model, ENV, OBS, OBS, everywhere, scalars).actions
        obs, asked = jnp.tile(OBS[:1], (40, 1)), jnp.tile(own[:1], (40, 1))
        told = fit(KEY, ENV, labels(jnp.full((40, 1), h), obs, asked), model, scalars)
        moved = directions.difference(own, act(told, ENV, OBS, OBS, everywhere, scalars).actions)[0]
        assert np.degrees(moved) == pytest.approx(20 * h, abs=2)
