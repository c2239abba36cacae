"""The bundles of guidance: which rows they touch and when."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import actions
from cuelearner_jax.errors import UserError
from cuelearner_jax.guidance import feedback
from cuelearner_jax.guidance import registry as guidance
from cuelearner_jax.types import Label

ENV = probes.Window()
OBS = actions.evenly_spaced(6)
BASE = actions.rotate(OBS, 0.3)
ACTIVE = np.array([True, False, True, True, False, False])


def made(kind):
    bundle = guidance.make(kind, probes.SIZES, 2)
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
    np.testing.assert_allclose(actions.difference(OBS, result.actions)[ACTIVE], -1.0, atol=1e-6)
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
    assert np.abs(actions.difference(BASE, after.actions))[ACTIVE].min() > 0
    np.testing.assert_array_equal(np.asarray(after.passes) > 0, ACTIVE)


def test_relative_passes_on_its_bounds():
    bundle, model = made("relative")
    model = model.replace(fitted=jnp.array(True))
    bounded = dataclasses.replace(probes.SCALARS, tau_max_deg=2.0, tau_deg=0.0, k_max=7)
    result = bundle.act(model, ENV, OBS, BASE, jnp.ones(6, bool), bounded)
    assert np.abs(actions.difference(BASE, result.actions)).max() <= math.radians(2.0) + 1e-5
    assert result.passes.tolist() == [7] * 6


def test_a_relative_label_is_the_vector_of_a_turn_by_eps():
    bundle, _ = made("relative")
    base = actions.from_angle(jnp.array(0.0))
    for best, h in ((1.0, 1), (-1.0, -1), (0.1, 0)):
        target, valid = bundle.label(jax.random.key(0), base, actions.from_angle(jnp.array(best)), probes.SCALARS)
        np.testing.assert_allclose(base + target, actions.from_angle(h * math.radians(20)), atol=1e-6)
        assert bool(valid)


def test_a_relative_label_comes_from_the_teacher_with_its_faults():
    bundle, _ = made("relative")
    base, best = actions.from_angle(jnp.array(0.0)), actions.from_angle(jnp.array(1.0))
    mistaken = dataclasses.replace(probes.SCALARS, mistake_probability=1.0)
    target, _ = bundle.label(jax.random.key(0), base, best, mistaken)
    np.testing.assert_allclose(base + target, actions.from_angle(-math.radians(20)), atol=1e-6)
    silent = dataclasses.replace(probes.SCALARS, silence_probability=1.0)
    assert not bool(bundle.label(jax.random.key(0), base, best, silent)[1])


def test_a_fitted_model_turns_actions_by_what_was_told_whatever_its_strength():
    bundle, _ = made("relative")
    rng = np.random.default_rng(0)
    obs, base = (actions.from_angle(jnp.array(rng.uniform(-math.pi, math.pi, 100))) for _ in range(2))
    fit = jax.jit(bundle.fit)
    for eps_deg, h in ((20.0, 1.0), (1.0, -1.0)):
        scalars = dataclasses.replace(probes.SCALARS, eps_deg=eps_deg, tau_deg=0.0, k_max=1)
        target = feedback.relative_target(base, jnp.array(h), scalars.radians("eps"))
        model = fit(jax.random.key(0), ENV, Label(obs, base, target, jnp.ones(100, bool)), scalars)
        assert bool(model.fitted)
        turned = actions.difference(base, bundle.act(model, ENV, obs, base, jnp.ones(100, bool), scalars).actions)
        assert np.mean(np.degrees(turned)) == pytest.approx(h * eps_deg, rel=0.15)
        assert np.std(np.degrees(turned)) < 0.3 * eps_deg


@pytest.mark.parametrize("kind", ["none", "heuristic"])
def test_guidance_that_never_asks_has_no_valid_labels_and_never_fits(kind):
    bundle, _ = made(kind)
    target, valid = bundle.label(jax.random.key(0), BASE[0], OBS[0], probes.SCALARS)
    assert not bool(valid)
    assert target.shape == (2,)
    assert not bool(bundle.fit(jax.random.key(0), ENV, None, probes.SCALARS).fitted)


@pytest.mark.parametrize("kind", guidance.KINDS)
def test_every_kind_is_called_by_its_name(kind):
    assert guidance.make(kind, probes.SIZES, 2).name == kind


def test_an_unknown_kind_is_a_user_error():
    with pytest.raises(UserError, match="telepathy"):
        guidance.make("telepathy", probes.SIZES, 2)
