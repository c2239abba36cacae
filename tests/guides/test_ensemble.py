"""Ensembles: their mean, how far members are apart, which question that chooses."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import asking
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.guides import registry
from cuelearner_jax.guides.fitting import ensemble
from cuelearner_jax.guides.relative import Relative
from cuelearner_jax.policies import Uniform
from cuelearner_jax.spaces import directions

ENV = probes.Aimed()
OBS = directions.evenly_spaced(5)
BASE = jax.jit(directions.rotate)(OBS, 0.3)
ONE = dataclasses.replace(probes.SIZES, feedback_layers=(8,), fit_steps=20)
FOUR = dataclasses.replace(ONE, ensemble=4)
CHOOSING = dataclasses.replace(FOUR, candidates=6)


class AboutBase(Relative):
    """Asks about the base action always."""

    def question(self, key, model, env, obs, base, scalars):
        return base


class Told(AboutBase):
    """Its members disagree as told."""

    def disagreement(self, model, env, obs, actions):
        return 2 * obs[:, 0] + actions[:, 1]


def made(guide, sizes):
    return guide(sizes, spaces_of(ENV))


def linear(env, params, obs, actions):
    """Two outputs: the observation's first entry times a member's number, and the action's."""
    return jnp.stack([params * obs[:, 0], params * actions[:, 0]], -1)


def test_an_ensemble_predicts_its_members_mean_and_tells_their_variance():
    several = ensemble(3, jax.random.normal, linear)
    params = jnp.array([1.0, 2.0, 6.0])
    np.testing.assert_allclose(several.predict(None, params, OBS, BASE), linear(None, 3.0, OBS, BASE), rtol=1e-6)
    apart = several.disagreement(None, params, OBS, BASE)
    np.testing.assert_allclose(apart, 14 / 3 * (OBS[:, 0] ** 2 + BASE[:, 0] ** 2), rtol=1e-5)
    some = jnp.array([[1.0, 0.0], [-3.0, 0.0]])  # -1 in the mean; what members add in a situation falls out
    less = several.disagreement(None, params, OBS, BASE, some)
    np.testing.assert_allclose(less, 14 / 3 * (BASE[:, 0] + 1) ** 2, rtol=1e-4, atol=1e-6)
    assert len(set(np.asarray(several.init(jax.random.key(0))).tolist())) == 3


@pytest.mark.parametrize(
    "kind",
    probes.long_but(["relative"], ["relative", "demonstration", "scalar", "dcoach", "bdcoach", "clic", "intent"]),
)
def test_members_that_are_the_same_do_what_one_does_and_do_not_disagree(kind):
    single, several = (registry.make(kind, sizes, ENV) for sizes in (ONE, FOUR))
    alone = single.init(jax.random.key(0)).replace(fitted=jnp.array(True))
    same = alone.replace(params=jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), alone.params))
    everywhere = jnp.ones(5, bool)
    one, mean = (b.act(m, ENV, OBS, BASE, everywhere, probes.SCALARS) for b, m in ((single, alone), (several, same)))
    np.testing.assert_allclose(one.actions, mean.actions, atol=1e-5)
    np.testing.assert_allclose(several.disagreement(same, ENV, OBS, BASE), 0, atol=1e-10)
    add = jax.vmap(lambda number, params: jax.tree.map(lambda leaf: leaf + 0.1 * number, params))
    assert several.disagreement(same.replace(params=add(jnp.arange(4.0), same.params)), ENV, OBS, BASE).min() > 1e-6


# Which question.


def begun(guidance, sizes, budget=20):
    slots = asking.label_slots(budget, sizes)
    return asking.start(guidance, ENV, slots, budget, jax.random.key(1), jax.random.key(2), sizes)


def test_the_candidate_is_asked_about_on_which_members_disagree_most_and_all_walk_on():
    told = made(Told, CHOOSING)
    guide = begun(told, CHOOSING)
    assert guide.obs.shape == (6, 2)
    assert len(np.unique(np.asarray(guide.obs), axis=0)) > 1
    fitted = guide.replace(model=guide.model.replace(fitted=jnp.array(True)))
    key, expert = jax.random.key(7), probes.Expert(ENV)
    keys = asking.question_keys(key, 0)
    proposed = Uniform().act(keys.base, fitted.env, fitted.obs)
    best = int(np.argmax(2 * fitted.obs[:, 0] + proposed[:, 1]))
    assert best != 0
    for asked, index in ((guide, 0), (fitted, best)):  # members that were never fitted have no say
        after = asking.ask(asking.Inquiry(told, ENV, probes.SCALARS, Uniform()), expert, asked, key, jnp.asarray(0))
        np.testing.assert_array_equal(after.labels.obs[0], asked.obs[index])
        np.testing.assert_array_equal(after.labels.action[0], proposed[index])
        error = directions.difference(proposed[index], ENV.best(asked.obs[index]))
        h = 0.0 if abs(float(error)) <= np.deg2rad(10) else float(np.sign(error))
        assert after.labels.answer[0].tolist() == [h]
        assert after.labels.valid.sum() == 1
        states, steps = jax.vmap(ENV.step)(jax.random.split(keys.env, 6), asked.env, proposed)
        chex.assert_trees_all_equal((after.env, after.obs), (states, steps.obs))


def test_rounds_of_chosen_questions_fill_the_budget_and_fit_each_member_from_numbers_of_its_own():
    several = registry.make("relative", CHOOSING, ENV)
    guide, expert, key = begun(several, CHOOSING, budget=15), probes.Expert(ENV), jax.random.key(3)
    one = probes.label_rounds(several, CHOOSING)
    for _ in range(2):
        guide = one(ENV, expert, probes.SCALARS, Uniform(), guide, key)
    assert np.asarray(guide.labels.valid).tolist() == [True] * 15 + [False] * 5
    assert int(guide.asked) == 15
    assert bool(guide.model.fitted)
    chex.assert_tree_shape_prefix(guide.model.params, (4,))
    for kernel in (leaf for leaf in jax.tree.leaves(guide.model.params) if leaf.ndim == 3):
        assert all(not np.array_equal(kernel[i], kernel[j]) for i in range(4) for j in range(i))


def test_every_candidate_is_asked_about_at_once_within_the_budget():
    sizes = dataclasses.replace(ONE, candidates=6, ask_all=True, labels_per_round=12)
    single = made(AboutBase, sizes)
    slots, key, expert = asking.label_slots(21, sizes), jax.random.key(7), probes.Expert(ENV)
    assert slots == 24
    guide = asking.start(single, ENV, slots, 21, jax.random.key(1), jax.random.key(2), sizes)
    keys = asking.question_keys(key, 12)
    proposed = Uniform().act(keys.base, guide.env, guide.obs)
    of = asking.Inquiry(single, ENV, probes.SCALARS, Uniform())
    after = asking.ask(of, expert, guide, key, jnp.asarray(12), every=True)
    np.testing.assert_array_equal(after.labels.obs[12:18], guide.obs)
    np.testing.assert_array_equal(after.labels.action[12:18], proposed)
    errors = jax.vmap(directions.difference)(proposed, jax.vmap(ENV.best)(guide.obs))
    h = np.where(np.abs(errors) <= np.deg2rad(10), 0.0, np.sign(errors))
    assert set(h) >= {-1.0, 1.0}
    np.testing.assert_array_equal(after.labels.answer[12:18, 0], h)
    assert np.flatnonzero(after.labels.valid).tolist() == list(range(12, 18))
    states, steps = jax.vmap(ENV.step)(jax.random.split(keys.env, 6), guide.env, proposed)
    chex.assert_trees_all_equal((after.env, after.obs), (states, steps.obs))
    one = probes.label_rounds(single, sizes)
    for _ in range(2):
        guide = one(ENV, expert, probes.SCALARS, Uniform(), guide, key)
    assert np.asarray(guide.labels.valid).tolist() == [True] * 21 + [False] * 3
    assert (int(guide.asked), bool(guide.model.fitted)) == (21, True)
    assert len(np.unique(np.asarray(guide.labels.action)[:21], axis=0)) == 21
