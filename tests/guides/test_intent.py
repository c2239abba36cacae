"""Relative feedback read as intent: what an answer says of each aim, and what the fitted weights make of actions."""

import dataclasses
import math
from functools import cache, partial

import box_task
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.environment import Aims, actions_of
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides import intent, registry
from cuelearner_jax.spaces import DIRECTIONS, directions
from cuelearner_jax.types import Label

ENV = probes.Aimed()
SIZES, OPTIONS = probes.SIZES, intent.IntentConfig(aim_layers=(8,))
OBS = directions.evenly_spaced(16)
BASE = jax.jit(lambda: directions.rotate(OBS, jnp.linspace(-3.0, 3.0, 16)))()
EVERYWHERE = jnp.ones(16, bool)


def told(sizes, env=ENV, options=OPTIONS):
    """A bundle and its model of 40 of the expert's answers about random actions."""
    bundle = registry.make("intent", sizes, env, options)
    former, labels = bundle.init(jax.random.key(0)), labels_in(ENV, probes.SCALARS)
    return bundle, jax.jit(bundle.fit)(jax.random.key(1), env, labels, former, probes.SCALARS)


@partial(jax.jit, static_argnames="count")
def labels_in(env, scalars, count=40):
    """The expert's answers about random actions."""

    def one(key):
        _, obs = env.reset(key)
        asked = actions_of(env).sample(jax.random.fold_in(key, 1))
        answer, answered = RELATIVE.answer(key, env, probes.Expert(env), obs, obs, asked, scalars)
        return Label(obs, asked, answer, answered)

    return jax.vmap(one)(jax.random.split(jax.random.key(3), count))


@cache
def act_in(world):
    """A compiled `act` for each class of worlds: JAX takes classes of equal fields for one."""
    return jax.jit(lambda bundle, *given: bundle.act(*given), static_argnums=0)


def act(bundle, model, env, *given):
    return act_in(type(env))(bundle, model, env, *given)


class Shut(probes.Aimed):
    """Its expert means the second aim, which nobody is to follow."""

    def aims(self, obs):
        return super().aims(obs)._replace(open=jnp.array([True, False, True, True]))


def test_what_is_not_open_may_be_meant_and_is_not_followed(fitted):
    bundle, model = fitted
    bundle = dataclasses.replace(bundle, options=dataclasses.replace(OPTIONS, aim_doubt=1e9))
    scalars = dataclasses.replace(probes.SCALARS, k_max=200)
    found = act(bundle, model, Shut(), OBS, BASE, EVERYWHERE, scalars).actions
    second = directions.rotate(OBS, jnp.asarray(0.6))
    meant = act(bundle, model, ENV, OBS, BASE, EVERYWHERE, scalars).actions
    np.testing.assert_allclose(DIRECTIONS.distance(meant, second), 0.0, atol=1e-3)
    assert np.asarray(DIRECTIONS.distance(found, second)).min() > 0.5


class Alone(probes.Aimed):
    def aims(self, obs):
        return super().aims(obs)._replace(open=jnp.arange(4) == 2)


def test_any_aim_leads_to_the_nearest_that_may_be_followed():
    bundle, obs = registry.make("any_aim", SIZES, ENV), jnp.array([[1.0, 0.0]])
    base = directions.rotate(obs, jnp.array([-0.7]))
    for env, turn in ((ENV, -1.0), (Alone(), 2.5)):
        acted = act(bundle, bundle.init(jax.random.key(0)), env, obs, base, jnp.ones(1, bool), probes.SCALARS)
        np.testing.assert_allclose(acted.actions, directions.rotate(obs, jnp.array([turn])), atol=1e-6)


@pytest.fixture(scope="module")
def fitted():
    return told(SIZES)


def acted(fitted, env, base=BASE, **scalars):
    bundle, model = fitted
    return act(bundle, model, env, OBS, base, EVERYWHERE, dataclasses.replace(probes.SCALARS, **scalars))


def test_an_answer_makes_aims_on_its_side_likely():
    goals = directions.from_angle(jnp.deg2rad(jnp.array([-90.0, 0.0, 9.0, 10.0, 90.0])))
    action, eps = directions.from_angle(jnp.array(0.0)), jnp.deg2rad(20.0)
    words = jnp.stack([intent.likelihood(DIRECTIONS, action, goals, jnp.array([h]), eps) for h in (-1.0, 0.0, 1.0)])
    np.testing.assert_allclose(words.sum(0), 1.0, atol=1e-6)
    # Logistic: 1 / (1 + e) beyond an edge that lies one degree away; half on the edge, at eps / 2 = 10 degrees.
    np.testing.assert_allclose(words[2], [0.0, 0.0, 1.0 / (1.0 + math.e), 0.5, 1.0], atol=1e-4)
    np.testing.assert_allclose(words[0], [1.0, 0.0, 0.0, 0.0, 0.0], atol=1e-4)


def test_coarse_answers_lead_exactly_to_the_aim_that_is_meant(fitted):
    assert probes.SCALARS.eps_deg == 20.0
    refined = acted(fitted, ENV)
    np.testing.assert_allclose(directions.difference(ENV.best(OBS), refined.actions), 0.0, atol=1e-5)
    # ceil(turn / eps) passes, and one that finds nothing left to do.
    turns = np.degrees(np.abs(np.asarray(directions.difference(BASE, ENV.best(OBS)))))
    assert (np.abs(np.asarray(refined.passes) - (np.ceil(turns / 20.0) + 1)) <= 1).all()


def test_a_pass_goes_by_at_most_eps(fitted):
    away = np.degrees(np.abs(np.asarray(directions.difference(BASE, acted(fitted, ENV, k_max=1).actions))))
    assert away.max() == pytest.approx(20.0, abs=1e-3)


def test_in_a_box_answers_lead_to_the_aim_that_is_meant():
    class Boxed(box_task.Reach):
        """Three aims, of which the second is the goal; the features tell which they are."""

        def aims(self, obs):
            changes = jnp.array([[0.3] * 3, [0.0] * 3, [-0.25] * 3])
            moved = jax.vmap(lambda change: self.actions.exp(self.best(obs), change))(changes)
            return Aims(moved, jnp.eye(3), jnp.ones(3, bool))

    env, scalars, key = Boxed(), box_task.SCALARS, jax.random.key(1)
    labels, bundle = labels_in(env, scalars, 60), registry.make("intent", SIZES, env, OPTIONS)
    model = jax.jit(bundle.fit)(key, env, labels, bundle.init(key), scalars)
    found = act(bundle, model, env, labels.obs, labels.action, labels.valid, scalars).actions
    assert (
        np.median(jax.jit(jax.vmap(lambda obs, one: env.actions.distance(env.best(obs), one)))(labels.obs, found))
        < 0.06
    )


def test_actions_stay_where_it_is_likelier_by_far_that_none_is_meant():
    aims = directions.evenly_spaced(3)
    for none, sure in ((math.log(3.9), True), (math.log(4.1), False)):
        share = jax.nn.softmax(jnp.array([0.0, math.log(2.0), -jnp.inf, none]))
        goal, found = intent.choose_aim(DIRECTIONS, share, aims, aims[0], 2.0)
        np.testing.assert_array_equal(goal, aims[1])
        assert bool(found) == sure
    assert not intent.choose_aim(DIRECTIONS, jnp.array([0.0, 0.0, 0.0, 1.0]), aims, aims[0], 2.0)[1]


def test_of_aims_as_likely_as_the_likeliest_the_nearest_is_followed():
    space, aims = DIRECTIONS, directions.evenly_spaced(4)  # at 0, 90, 180 and 270 degrees
    # Probabilities 4 : 4 : 3.1 : 0, the last impossible; three quarters of all that none is meant.
    share = jnp.array([4.0, 4.0, 3.1, 0.0, 33.3]) / 44.4
    for degrees, aim in ((80.0, 1), (30.0, 0), (170.0, 1), (200.0, 1), (271.0, 0)):
        found, sure = intent.choose_aim(space, share, aims, directions.from_angle(jnp.deg2rad(degrees)), 100.0)
        np.testing.assert_array_equal(found, aims[aim], err_msg=str(degrees))
        assert sure


@pytest.mark.long
def test_members_weigh_aims_each_by_itself_and_their_mean_leads():
    bundle, model = told(dataclasses.replace(SIZES, ensemble=3))
    lead = acted((bundle, model), ENV).actions
    np.testing.assert_allclose(directions.difference(ENV.best(OBS), lead), 0.0, atol=1e-5)
    members = [jax.tree.map(lambda leaf, i=i: leaf[i], model.params) for i in range(3)]
    assert not np.array_equal(*(one["params"]["Dense_0"]["kernel"] for one in members[1:]))
    # One that believes in no aim does not decide for the others, however sure it is.
    members = [{"params": members[0]["params"] | {"none": jnp.array([50.0])}}, *members[1:]]
    outvoted = model.replace(params=jax.tree.map(lambda *leaves: jnp.stack(leaves), *members))
    np.testing.assert_array_equal(acted((bundle, outvoted), ENV).actions, lead)
    network, aims = intent.Weights(OPTIONS.aim_layers), ENV.aims(OBS[0])
    shares = np.stack([jax.nn.softmax(network.apply(one, aims.features, aims.possible)) for one in members])
    apart = bundle.disagreement(outvoted, ENV, OBS, BASE)
    assert apart[0] > 10 * bundle.disagreement(model, ENV, OBS, BASE)[0]
    np.testing.assert_allclose(apart[0], shares.var(0).sum(), rtol=1e-4)
    np.testing.assert_array_equal(apart, bundle.disagreement(outvoted, ENV, OBS, OBS))  # whatever the action
