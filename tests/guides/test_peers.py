"""BD-COACH and CLIC: what their papers say of single labels, by numbers that a hand can compute."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from box_task import SCALARS, SMALL, Reach

from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.guides import clic, registry
from cuelearner_jax.spaces import UNSAID
from cuelearner_jax.types import Label

ENV = Reach()
SIZES = GuideSizes(feedback_layers=(16,), labels_per_round=10, fit_steps=100, fit_batch_size=16)
KEY = jax.random.key(3)
SEEN = jnp.array([[1.0, 0.0], [0.0, 1.0]])
MIDDLE = SMALL.middle()
exp, log = jax.jit(SMALL.exp), jax.jit(SMALL.log)


def log_sigmoid(value):
    return -np.log1p(np.exp(-np.asarray(value)))


@jax.jit
def log_desired(x, h, implicit, gamma):
    return jax.vmap(lambda x: clic.log_desired(x, h, implicit, gamma))(x)


@partial(jax.jit, static_argnums=2)
def directions_at(h, angle_deg, count):
    return jax.vmap(lambda key: clic.direction_at(key, h, jnp.deg2rad(angle_deg)))(jax.random.split(KEY, count))


@cache
def made(kind, **sizes):
    return registry.make(kind, dataclasses.replace(SIZES, **sizes), ENV)


# CLIC's sets.


def test_a_half_space_along_one_cue_ends_halfway_to_the_better_action():
    """|x| - |x - 1| is -1, 0, 0.5, 1 at x = -2, 1/2, 3/4, 2: twice that, for the softness is 1/2."""
    x = jnp.array([[-2.0], [0.5], [0.75], [2.0]])
    log_p = log_desired(x, jnp.array([1.0]), jnp.ones((4, 1)), gamma=1.0)
    np.testing.assert_allclose(log_p, log_sigmoid([-2.0, 0.0, 1.0, 2.0]), atol=1e-5)
    np.testing.assert_allclose(log_desired(-x, jnp.array([-1.0]), -jnp.ones((4, 1)), 1.0), log_p, atol=1e-6)
    beside = jnp.concatenate([x, jnp.ones((4, 1))], 1)  # of several cues one is named
    np.testing.assert_allclose(log_desired(beside, jnp.array([1.0, UNSAID]), jnp.ones((4, 2)), 1.0), log_p, atol=1e-6)
    near = log_desired(x, jnp.array([1.0]), jnp.ones((4, 1)), gamma=0.1)  # the edge lies at 0.05
    np.testing.assert_allclose(near, log_sigmoid([-0.2, 0.2, 0.2, 0.2]), atol=1e-5)


def test_implicit_pairs_narrow_the_half_space():
    """h = (1, 0), u = (0, 1), gamma 1/2: the worse action is (1/2, 1/2). At (0, 2) and (1, 0) by Pythagoras."""
    log_p = log_desired(jnp.array([[0.0, 2.0], [1.0, 0.0]]), jnp.array([1.0, 0.0]), jnp.array([[0.0, 1.0]]), gamma=0.5)
    pair = log_sigmoid([2 * (np.sqrt(2.5) - np.sqrt(5.0)), 2 * (np.sqrt(0.5) - 0.0)])
    moving = (pair + 0.3 * log_sigmoid([2 * (2.0 - np.sqrt(4.25)), 2 * (1.0 - 0.5)])) / 1.3
    right = [(log_sigmoid(2 * (1.0 - 2.0)) + log_sigmoid(2 * (3.0 - 2.0))) / 2, log_sigmoid(2.0)]
    np.testing.assert_allclose(log_p, (moving + np.array(right)) / 2, atol=1e-5)  # the second cue is already right


def test_already_right_holds_the_action_between_its_neighbours():
    log_p = np.asarray(log_desired(jnp.array([[-1.0], [0.0], [0.4], [1.0]]), jnp.zeros(1), jnp.zeros((4, 1)), 0.1))
    assert log_p.argmax() == 1
    assert log_p[0] == pytest.approx(log_p[3], abs=1e-6)
    np.testing.assert_allclose(log_p[3], (log_sigmoid(-2.0) + log_sigmoid(2.0)) / 2, atol=1e-5)


def test_a_cue_of_which_nothing_was_said_is_no_evidence():
    h = jnp.array([1.0, UNSAID, 0.0])
    x = jax.random.normal(KEY, (5, 3))
    implicit = directions_at(h, 30.0, 4)
    elsewhere = x.at[:, 1].add(jnp.arange(5.0))
    np.testing.assert_array_equal(implicit[:, 1], 0.0)
    one, other = (log_desired(rows, h, implicit, 0.1) for rows in (x, elsewhere))
    np.testing.assert_array_equal(one, other)


def test_implicit_directions_are_as_long_as_the_answer_and_lie_at_their_angle():
    h = jnp.array([1.0, -1.0, 0.0])
    found = directions_at(h, 30.0, 7)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), np.sqrt(2.0), rtol=1e-5)
    np.testing.assert_allclose(found @ h / 2.0, np.cos(np.deg2rad(30.0)), rtol=1e-5)
    alone = jnp.array([UNSAID, -1.0, UNSAID])  # there is no other direction along one cue
    np.testing.assert_allclose(directions_at(alone, 30.0, 2), [[0.0, -1.0, 0.0]] * 2, atol=1e-6)


def test_what_was_shown_has_a_ball_whose_radius_is_a_share_of_the_way_there():
    """Shown two eps away, radius one eps: members at 0, 1 and 2 eps from it by (1 - distance) / softness."""
    guide, eps = made("clic_shown"), SCALARS.eps_deg
    shown = exp(MIDDLE, jnp.array([2 * eps, 0.0, 0.0]))
    row = contrast("clic_shown", MIDDLE, shown)
    away = np.array([[0.0], [1.0], [2.0]]) * np.array([0.0, eps, 0.0])
    log_p = jax.jit(guide.membership)(KEY, row, exp(jnp.tile(shown, (3, 1)), jnp.asarray(away, jnp.float32)), SCALARS)
    np.testing.assert_allclose(log_p, clic.SHARPNESS * log_sigmoid(np.array([1.0, 0.0, -1.0]) / 0.25), rtol=1e-4)


# CLIC's loss and its policy.


def contrast(kind, action, answer):
    """One label as CLIC learns from it."""
    rows = jax.jit(made(kind).examples)(labels(action[None], answer[None]), SCALARS)
    return jax.tree.map(lambda leaf: leaf[0], rows)


def labels(action, answer, obs=None, base=None):
    count = len(action)
    obs = jnp.broadcast_to(SEEN[0], (count, 2)) if obs is None else obs
    return Label(obs, action, answer, jnp.ones(count, bool), base)


@pytest.mark.long
def test_the_loss_has_the_gradient_of_the_papers_divergence():
    """-log sum pi p has the gradient of KL(target || pi), target ~ pi p held fixed."""
    guide = made("clic")
    params = guide.network.init(KEY)
    rows = guide.examples(labels(MIDDLE[None], jnp.array([[1.0, 0.0, UNSAID]])), SCALARS)
    k_pairs, k_sample = jax.random.split(jax.random.fold_in(jax.random.key(0), 0))
    row = jax.tree.map(lambda leaf: leaf[0], rows)
    actions = guide.sample_actions(k_sample, row, SCALARS)
    inside = guide.membership(k_pairs, row, actions, SCALARS)

    def divergence(params):
        log_pi = jax.nn.log_softmax(-guide.energy(ENV, params, row.obs, actions, None, SCALARS))
        target = jax.lax.stop_gradient(jax.nn.softmax(log_pi + inside))
        return jnp.sum(target * (jnp.log(target) - log_pi))

    wanted = jax.jit(jax.grad(divergence))(params)
    found = jax.jit(jax.grad(lambda params: guide.losses(ENV, SCALARS, params, rows).sum()))(params)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)


def test_the_least_energy_lies_on_the_corrected_side():
    guide = made("clic")
    told = labels(jnp.tile(MIDDLE, (10, 1)), jnp.tile(jnp.array([1.0, -1.0, UNSAID]), (10, 1)))
    scalars = dataclasses.replace(SCALARS, feedback_learning_rate=1e-2)
    model = jax.jit(guide.fit)(KEY, ENV, told, guide.init(KEY), scalars)
    acted = jax.jit(guide.act)(model, ENV, SEEN, jnp.tile(MIDDLE, (2, 1)), jnp.ones(2, bool), scalars)
    moved = log(MIDDLE, acted.actions[0])
    assert moved[0] > 0.05
    assert moved[1] < -0.05


class Bowl(clic.Clic):
    """An energy whose least place is known, a corner of it beyond most bounds."""

    def energy(self, env, params, obs, actions, base, scalars):
        least = SMALL.exp(MIDDLE, jnp.array([0.21, -0.37, 0.0]))
        return jnp.sum(jnp.square(SMALL.log(jnp.broadcast_to(least, actions.shape), actions)), -1)


def test_the_search_finds_the_least_energy_within_the_bound_and_always_the_same():
    guide = Bowl(SIZES, Spaces(2, SMALL))
    model = guide.init(KEY).replace(fitted=jnp.array(True))
    act, first = jax.jit(guide.act), SMALL.sample(KEY, (4,)).at[0].set(MIDDLE)
    obs, active = jnp.zeros((4, 2)), jnp.array([True, True, True, False])
    far, again = (act(model, ENV, obs, first, active, SCALARS).actions for _ in range(2))
    np.testing.assert_array_equal(far, again)
    np.testing.assert_array_equal(far[3], first[3])
    np.testing.assert_allclose(log(jnp.tile(MIDDLE, (3, 1)), far[:3]), [[0.21, -0.37, 0.0]] * 3, atol=0.02)
    near = act(model, ENV, obs, first, active, dataclasses.replace(SCALARS, tau_max_deg=0.1)).actions
    assert np.abs(log(first, near)).max() <= 0.1 + 1e-5
    np.testing.assert_allclose(log(MIDDLE, near[0]), [0.1, -0.1, 0.0], atol=0.02)


# BD-COACH.


def silent(guide):
    """Return parameters of the human model that say "already right" everywhere."""
    start = guide.init(KEY).params.human
    return {**start, "params": jax.tree.map(jnp.zeros_like, start["params"])}


def test_the_human_model_leads_the_policy_by_eps_at_most_and_along_all_cues():
    guide = made("bdcoach")
    params = silent(guide)
    acted = jnp.tile(MIDDLE, (2, 1))
    rows = jax.jit(guide.examples)(labels(acted, jnp.array([[1.0, UNSAID, 0.0]] * 2)), SCALARS)
    targets = jax.jit(guide.policy_targets)
    still = targets(ENV, params, rows, acted, SCALARS)
    np.testing.assert_allclose(still.target, acted, atol=1e-6)  # it says "already right"
    assert still.cues.all()
    loud = jax.tree.map(lambda leaf: jnp.full_like(leaf, 9.0) if leaf.shape == (3,) else leaf, params)
    np.testing.assert_allclose(log(acted, targets(ENV, loud, rows, acted, SCALARS).target), SCALARS.eps_deg, rtol=1e-5)


def test_the_human_model_is_taught_answers_and_nothing_of_other_cues():
    """Ranges 2, 4, 2: an answer of 1 is missed by a whole range of 2, so by one in the space's unit."""
    guide = made("bdcoach")
    params = silent(guide)
    told = [[1.0, UNSAID, UNSAID], [1.0, 0.0, UNSAID], [1.0, -1.0, 0.0]]
    examples, loss = jax.jit(guide.examples), jax.jit(guide.human_loss)
    rows = [examples(labels(MIDDLE[None], jnp.array([answer])), SCALARS) for answer in told]
    np.testing.assert_allclose([float(loss(ENV, params, row, SCALARS)) for row in rows], [1.0, 1.0, 2.0], rtol=1e-4)
