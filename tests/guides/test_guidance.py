"""Guides: which rows they touch and when, what they ask about, how they are found."""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import run_config
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import intent
from cuelearner_jax.guides import registry as guidance
from cuelearner_jax.guides.base import Kind
from cuelearner_jax.guides.baselines import NONE, Untaught
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import directions
from cuelearner_jax.types import Label

ENV = probes.Window()
OBS = directions.evenly_spaced(6)
BASE = jax.jit(directions.rotate)(OBS, 0.3)
ACTIVE = jnp.array([True, False, True, True, False, False])


def made(kind):
    bundle = guidance.make(kind, probes.SIZES, ENV)
    return bundle, bundle.init(jax.random.key(0))


def test_none_is_the_identity():
    bundle, model = made("none")
    result = bundle.act(model, ENV, OBS, BASE, jnp.ones(6, bool), probes.SCALARS)
    np.testing.assert_array_equal(result.actions, BASE)
    assert not bundle.asks
    assert result.passes.tolist() == [0] * 6


def test_heuristic_replaces_the_active_rows_only():
    bundle, model = made("heuristic")
    result = bundle.act(model, ENV, OBS, BASE, ACTIVE, probes.SCALARS)
    assert not bundle.asks
    np.testing.assert_allclose(directions.difference(OBS, result.actions)[ACTIVE], -1.0, atol=1e-6)
    np.testing.assert_array_equal(result.actions[~ACTIVE], BASE[~ACTIVE])
    assert result.passes.tolist() == [1, 0, 1, 1, 0, 0]


def test_relative_refines_active_rows_once_it_is_fitted():
    bundle, model = made("relative")
    assert bundle.asks
    assert not bool(model.fitted)
    before = bundle.act(model, ENV, OBS, BASE, ACTIVE, probes.SCALARS)
    np.testing.assert_array_equal(before.actions, BASE)
    assert before.passes.tolist() == [0] * 6
    after = bundle.act(model.replace(fitted=jnp.array(True)), ENV, OBS, BASE, ACTIVE, probes.SCALARS)
    np.testing.assert_array_equal(after.actions[~ACTIVE], BASE[~ACTIVE])
    assert np.abs(directions.difference(BASE, after.actions))[ACTIVE].min() > 0
    np.testing.assert_array_equal(np.asarray(after.passes) > 0, ACTIVE)


def test_a_fitted_model_turns_actions_by_what_was_told_whatever_its_strength():
    bundle, former = made("relative")
    rng = np.random.default_rng(0)
    obs, base = (directions.from_angle(jnp.array(rng.uniform(-math.pi, math.pi, 100))) for _ in range(2))
    fit = jax.jit(bundle.fit)
    for eps_deg, h in ((20.0, 1.0), (1.0, -1.0)):
        scalars = dataclasses.replace(probes.SCALARS, eps_deg=eps_deg, tau_deg=0.0, k_max=1)
        labels = Label(obs, base, jnp.full((100, 1), h), jnp.ones(100, bool))
        model = fit(jax.random.key(0), ENV, labels, former, scalars)
        assert bool(model.fitted)
        turned = directions.difference(base, bundle.act(model, ENV, obs, base, jnp.ones(100, bool), scalars).actions)
        assert np.mean(np.degrees(turned)) == pytest.approx(h * eps_deg, rel=0.15)
        assert np.std(np.degrees(turned)) < 0.3 * eps_deg


def test_relative_fits_from_scratch_whatever_the_former_model():
    bundle, one = made("relative")
    other = bundle.init(jax.random.key(1)).replace(fitted=jnp.array(True))
    labels = Label(OBS, BASE, jnp.ones((6, 1)), jnp.ones(6, bool))
    fits = [jax.jit(bundle.fit)(jax.random.key(2), ENV, labels, former, probes.SCALARS) for former in (one, other)]
    chex.assert_trees_all_equal(*fits)


@pytest.mark.parametrize("kind", ["none", "heuristic"])
def test_guidance_that_never_asks_has_no_form_of_answers_and_never_fits(kind):
    bundle, model = made(kind)
    assert bundle.form is None
    assert bundle.target(Label(OBS[0], BASE[0], jnp.zeros(0), jnp.array(False)), probes.SCALARS).shape == (0,)
    labels = Label(OBS, BASE, jnp.zeros((6, 0)), jnp.ones(6, bool))
    assert not bool(bundle.fit(jax.random.key(0), ENV, labels, model, probes.SCALARS).fitted)


def test_within_a_bound_no_kind_leads_farther_and_rows_that_are_not_active_stay():
    for kind in ("heuristic", "relative"):
        bundle, model = made(kind)
        model = model.replace(fitted=jnp.array(True))
        result = bundle.act_within(jnp.array(0.01), model, ENV, OBS, BASE, ACTIVE, probes.SCALARS)
        away = np.abs(directions.difference(BASE, result.actions))
        assert away.max() <= 0.01 + 1e-6
        assert away[ACTIVE].max() == pytest.approx(0.01, abs=1e-5)  # of the heuristic's 1.3 rad
        np.testing.assert_array_equal(result.actions[~ACTIVE], BASE[~ACTIVE])
    bundle, model = made("heuristic")
    free = bundle.act_within(jnp.array(math.pi), model, ENV, OBS, BASE, ACTIVE, probes.SCALARS)
    alone = bundle.act(model, ENV, OBS, BASE, ACTIVE, probes.SCALARS)
    np.testing.assert_array_equal(free.actions, alone.actions)


# Questions.


def asked(question, share, fitted=True):
    bundle, model = made("relative")
    model = model.replace(fitted=jnp.array(fitted))
    scalars = dataclasses.replace(probes.SCALARS, refined_fraction=share)
    keys = jax.random.split(jax.random.key(0), 200)
    one = jax.jit(jax.vmap(lambda key: question(key, model, ENV, OBS[0], BASE[0], scalars)))
    refined = bundle.act(model, ENV, OBS[:1], BASE[:1], jnp.array([True]), scalars).actions[0]
    return np.asarray(one(keys)), np.asarray(refined)


def test_a_share_of_the_questions_is_about_refined_actions_and_the_rest_about_the_base():
    question = made("relative")[0].question
    found, refined = asked(question, 0.5)
    assert np.abs(refined - BASE[0]).max() > 1e-3
    moved = np.abs(found - refined).max(-1) < 1e-6
    np.testing.assert_array_equal(found[~moved], np.tile(BASE[0], ((~moved).sum(), 1)))
    assert moved.mean() == pytest.approx(0.5, abs=0.12)  # standard deviation 0.035
    np.testing.assert_allclose(asked(question, 1.0)[0], np.tile(refined, (200, 1)), atol=1e-6)
    np.testing.assert_array_equal(asked(question, 0.0)[0], np.tile(BASE[0], (200, 1)))


def test_questions_of_an_unfitted_model_are_about_the_base():
    found, _ = asked(made("relative")[0].question, 1.0, fitted=False)
    np.testing.assert_array_equal(found, np.tile(BASE[0], (200, 1)))


# The registry.


@pytest.fixture
def registered(monkeypatch):
    """What a test registers is forgotten after it."""
    monkeypatch.setattr(guidance, "_KINDS", dict(guidance._KINDS))


def kind_of(name, about="left alone", **fields):
    return Kind(name, about, Untaught, **fields)


@pytest.mark.parametrize("kind", guidance.kinds(), ids=lambda kind: kind.name)
def test_every_kind_is_called_by_its_name_and_made_as_it_is_announced(kind):
    bundle = guidance.make(kind.name, probes.SIZES, probes.Aimed())
    assert (bundle.name, bundle.form, bundle.asks) == (kind.name, kind.form, kind.asks)
    assert guidance.find(kind.name) is kind
    assert kind in guidance.kinds()
    assert kind.about  # what help pages say of it


def test_an_unknown_kind_is_a_user_error_that_names_the_nearest_and_the_way_to_ones_own():
    with pytest.raises(UserError, match="telepathy"):
        guidance.make("telepathy", probes.SIZES, ENV)
    says = "unknown guidance 'relativ', did you mean 'relative'.*package.module:NAME"
    with pytest.raises(UserError, match=says) as refusal:
        guidance.find("relativ")
    assert "\n" not in str(refusal.value)


def test_a_kind_can_be_registered_again_but_not_another_of_its_name(registered):
    one = kind_of("calm")
    assert guidance.register(one) is one
    assert guidance.register(one) is one
    assert [kind.name for kind in guidance.kinds()].count("calm") == 1
    assert guidance.make("calm", probes.SIZES, ENV).name == "calm"
    with pytest.raises(UserError, match="another guidance is already called 'calm': give yours another name"):
        guidance.register(kind_of("calm", about="another"))
    with pytest.raises(UserError, match="another guidance is already called 'none'"):
        guidance.register(kind_of("none"))
    assert guidance.find("calm") is one
    assert guidance.find("none") is NONE


@pytest.mark.parametrize("name", ["", "Calm", "9lives", "two words", "a/b", "a:b"])
def test_names_that_are_no_folders_are_refused(name):
    with pytest.raises(ValueError, match="lower-case letters"):
        kind_of(name)


@pytest.mark.parametrize("kind", ["none", "relative", "heuristic"])
def test_guides_of_the_same_settings_are_equal_and_hash_alike(kind):
    one = guidance.make(kind, probes.SIZES, ENV)
    for sizes, env in (
        (probes.SIZES, probes.Window(half_width=0.1, mirrors=True)),
        (dataclasses.replace(probes.SIZES), probes.Window(offset=1.0)),
        (probes.SIZES, jax.eval_shape(probes.Window)),
    ):
        same = guidance.make(kind, sizes, env)
        assert (same, hash(same)) == (one, hash(one))
    assert guidance.make(kind, dataclasses.replace(probes.SIZES, feedback_layers=(3,)), ENV) != one
    assert dataclasses.replace(one, options=1) != one


def test_a_kind_brings_options_of_its_own_which_a_run_keeps():
    own = intent.Config(aim_layers=(3,), aim_doubt=7.0)
    values = run_config.to_json(RunConfig(None, kinds={"intent": own}))
    known = run_config.from_json(None, values)
    assert known.kinds == {"intent": own}
    assert known.guide_in(probes.Aimed(), "intent").options == own
    assert RunConfig(None).guide_in(probes.Aimed(), "intent").options == intent.Config()
    elsewhere = run_config.from_json(
        None, {**values, "kinds": {"from-outside": {"way": 0.5}}}
    )  # its code is not loaded
    assert run_config.to_json(elsewhere)["kinds"] == {"from-outside": {"way": 0.5}}
    for name, wrong, says in (
        ("intent", {"aim_doubt": -1.0}, "intent.aim_doubt"),
        ("intent", {"doubt": 1.0}, "doubt"),
        ("relative", {"aim_doubt": 1.0}, "no options"),
    ):
        with pytest.raises(UserError, match=says):
            run_config.from_json(None, {**values, "kinds": {name: wrong}})


def test_a_kind_is_refused_where_the_environment_lacks_what_it_needs(registered):
    class Plain(probes.Chain):
        heuristic = None

    with pytest.raises(UserError, match="'heuristic' needs an environment with `heuristic`") as refusal:
        guidance.make("heuristic", probes.SIZES, Plain())
    assert "\n" not in str(refusal.value)
    guidance.register(kind_of("symmetric", needs=("mirror",)))
    assert guidance.make("symmetric", probes.SIZES, ENV).name == "symmetric"
    with pytest.raises(UserError, match="'symmetric' needs an environment with `mirror`"):
        guidance.make("symmetric", probes.SIZES, probes.Chain())
