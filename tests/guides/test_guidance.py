"""Guides: which rows they touch and when, what they ask about, how they are found."""

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import plugins, run_config
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import intent
from cuelearner_jax.guides import registry as guidance
from cuelearner_jax.guides.base import NoGuide
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import directions
from cuelearner_jax.types import Label

ENV = probes.Window()
OBS = directions.evenly_spaced(6)
BASE = jax.jit(directions.rotate)(OBS, 0.3)
ACTIVE = jnp.array([True, False, True, True, False, False])


def made(kind, fitted=False):
    guide = guidance.make(kind, probes.SIZES, ENV)
    return guide, guide.init(jax.random.key(0)).replace(fitted=jnp.array(fitted))


def test_a_fitted_model_turns_actions_by_what_was_told_whatever_its_strength():
    guide, former = made("relative")
    rng = np.random.default_rng(0)
    obs, base = (directions.from_angle(jnp.array(rng.uniform(-math.pi, math.pi, 100))) for _ in range(2))
    fit = jax.jit(guide.fit)
    for eps_deg, h in ((20.0, 1.0), (1.0, -1.0)):
        scalars = dataclasses.replace(probes.SCALARS, eps_deg=eps_deg, tau_deg=0.0, k_max=1)
        labels = Label(obs, base, jnp.full((100, 1), h), jnp.ones(100, bool))
        model = fit(jax.random.key(0), ENV, labels, former, scalars)
        assert bool(model.fitted)
        turned = directions.difference(base, guide.act(model, ENV, obs, base, jnp.ones(100, bool), scalars).actions)
        assert np.mean(np.degrees(turned)) == pytest.approx(h * eps_deg, rel=0.15)
        assert np.std(np.degrees(turned)) < 0.3 * eps_deg


def test_a_fit_from_scratch_ignores_the_former_model():
    guide, one = made("relative")
    other = guide.init(jax.random.key(1)).replace(fitted=jnp.array(True))
    labels = Label(OBS, BASE, jnp.ones((6, 1)), jnp.ones(6, bool))
    fit = jax.jit(guide.fit)
    fits = [fit(jax.random.key(2), ENV, labels, former, probes.SCALARS) for former in (one, other)]
    chex.assert_trees_all_equal(*fits)


def test_within_a_bound_no_kind_leads_farther_and_rows_that_are_not_active_stay():
    for kind in ("heuristic", "relative"):
        guide, model = made(kind, fitted=True)
        result = guide.act_within(jnp.array(0.01), model, ENV, OBS, BASE, ACTIVE, probes.SCALARS)
        away = np.abs(directions.difference(BASE, result.actions))
        assert away.max() <= 0.01 + 1e-6
        assert away[ACTIVE].max() == pytest.approx(0.01, abs=1e-5)  # of the heuristic's 1.3 rad
        np.testing.assert_array_equal(result.actions[~ACTIVE], BASE[~ACTIVE])


def test_a_share_of_the_questions_is_about_refined_actions_and_the_rest_about_the_base():
    guide, model = made("relative", fitted=True)
    refined = np.asarray(guide.act(model, ENV, OBS[:1], BASE[:1], jnp.array([True]), probes.SCALARS).actions[0])
    assert np.abs(refined - BASE[0]).max() > 1e-3
    keys = jax.random.split(jax.random.key(0), 200)
    ask = jax.jit(jax.vmap(guide.question, (0, None, None, None, None, None)))
    for share, fitted in ((0.5, True), (1.0, True), (0.0, True), (1.0, False)):
        scalars = dataclasses.replace(probes.SCALARS, refined_fraction=share)
        asked = np.asarray(ask(keys, model.replace(fitted=jnp.array(fitted)), ENV, OBS[0], BASE[0], scalars))
        moved = np.abs(asked - refined).max(-1) < 1e-6
        np.testing.assert_array_equal(asked[~moved], np.tile(BASE[0], ((~moved).sum(), 1)))
        assert moved.mean() == pytest.approx(share * fitted, abs=0.12)  # standard deviation 0.035


# The table of kinds.


def test_a_kind_can_be_added_again_but_not_another_of_its_name(monkeypatch):
    table = dict(guidance.guides())
    monkeypatch.setattr(guidance, "guides", lambda: table)
    calm, other = (type("Calm", (NoGuide,), {"name": name, "needs": ("mirror",)}) for name in ("calm", "none"))
    for _ in range(2):
        assert plugins.add(table, calm, "guidance") is calm
    assert guidance.make("calm", probes.SIZES, ENV).name == "calm"
    with pytest.raises(UserError, match="another guidance is already called 'none': give yours another name"):
        plugins.add(table, other, "guidance")
    with pytest.raises(UserError, match="'calm' needs an environment with `mirror`"):
        guidance.make("calm", probes.SIZES, probes.Chain())


@pytest.mark.parametrize("kind", ["none", "relative"])
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
    assert guidance.make("demonstration", probes.SIZES, ENV) != one
    assert dataclasses.replace(one, options=1) != one


def test_a_kind_brings_options_of_its_own_which_a_run_keeps():
    own = intent.IntentConfig(aim_layers=(3,), aim_doubt=7.0)
    values = run_config.to_json(RunConfig(None, kinds={"intent": own}))
    known = run_config.from_json(None, values)
    assert known.kinds == {"intent": own}
    assert known.guide_in(probes.Aimed(), "intent").options == own
    assert RunConfig(None).guide_in(probes.Aimed(), "intent").options == intent.IntentConfig()
    # The code of a kind from outside is not loaded.
    elsewhere = run_config.from_json(None, {**values, "kinds": {"from-outside": {"way": 0.5}}})
    assert run_config.to_json(elsewhere)["kinds"] == {"from-outside": {"way": 0.5}}
    with pytest.raises(UserError, match=r"intent\.aim_doubt"):
        run_config.from_json(None, {**values, "kinds": {"intent": {"aim_doubt": -1.0}}})
