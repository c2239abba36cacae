"""The kind `offset`: corrections that know how far an action has been turned already."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.adaptation.lanes import Adaptation, ask_round, begin, product, side_by_side, take_labels
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import offset, registry
from cuelearner_jax.policies import policy_of
from cuelearner_jax.runs.grid import Grid, check_grid
from cuelearner_jax.spaces import DIRECTIONS, directions
from cuelearner_jax.types import Label

ENV = probes.Window(half_width=jnp.deg2rad(jnp.array(6.0)))
EXPERT = probes.Expert(ENV)
SCALARS = dataclasses.replace(probes.SCALARS, eps_deg=5.0, tau_deg=0.25)
SIZES = GuideSizes(feedback_layers=(8,), fit_steps=40, fit_batch_size=8)
BUNDLE = registry.make("offset", SIZES, ENV)
MISS_DEG = 40.0


def missing(obs):
    """Misses the best direction by a constant angle."""
    return directions.rotate(obs, 0.6 + jnp.deg2rad(MISS_DEG))


BASE = policy_of(jax.jit(missing))


def test_the_spline_ends_where_answers_change_their_sign():
    turns = jnp.linspace(-10, 10, 81)
    spline = offset.fit_spline(turns, jnp.sign(4.0 - turns), jnp.ones(81, bool))
    before, after, beyond = offset.height(spline, jnp.array([3.0, 5.0, 25.0]))
    assert 0 < before < 1
    assert -1 < after < 0
    assert float(beyond) == pytest.approx(float(spline.heights[-1]))  # level where nothing was asked about
    # With half of the answers turned round it says nothing, and of no label it knows nothing.
    contrary = jnp.where(jnp.arange(81) % 2, 1.0, -1.0)
    assert float(jnp.abs(offset.fit_spline(turns, contrary, jnp.ones(81, bool)).heights).max()) < 0.2
    assert not offset.fit_spline(turns, contrary, jnp.zeros(81, bool)).heights.any()


def test_the_network_counts_as_much_as_held_out_labels_say():
    left = jnp.array([[1.0, 0.0], [0.0, 2.0], [9.0, 9.0]])
    valid = jnp.array([True, True, False])
    for factor, share in ((1.0, 1.0), (2.0, 0.5), (0.5, 1.0), (-1.0, 0.0), (0.0, 0.0)):
        assert float(offset.share_of(left, factor * left, valid)) == pytest.approx(share)
    # Half right: (1 * 1 + 2 * 0) / (1 * 1 + 1 * 1).
    assert float(offset.share_of(left, jnp.array([[1.0, 0.0], [1.0, 0.0], [7.0, 7.0]]), valid)) == pytest.approx(0.5)


def test_a_constant_miss_is_known_everywhere_from_forty_answers_a_fifth_of_them_wrong():
    keys = jax.random.split(jax.random.key(3), 50)
    obs = jax.vmap(lambda key: ENV.reset(key)[1])(keys)
    base = missing(obs)
    turn = jax.random.uniform(jax.random.key(4), (50,), minval=-60.0, maxval=60.0)
    asked = directions.rotate(base, jnp.deg2rad(turn))
    right = jnp.where(turn < -MISS_DEG, 1.0, -1.0)
    answers = jnp.where(jnp.arange(50) % 5 == 2, -right, right)[:, None]
    labels = Label(obs, asked, answers, jnp.ones(50, bool), base)
    former = BUNDLE.init(jax.random.key(0))
    model = jax.jit(BUNDLE.fit)(jax.random.key(1), ENV, labels, former, SCALARS)
    assert 0.0 <= float(model.params.share) <= 1.0
    everywhere = directions.evenly_spaced(24)
    moved = BUNDLE.act(model, ENV, everywhere, missing(everywhere), jnp.ones(24, bool), SCALARS).actions
    miss = np.degrees(np.asarray(DIRECTIONS.distance(moved, directions.rotate(everywhere, 0.6))))
    assert miss.mean() < 2 * SCALARS.eps_deg  # of 40
    # One pass from an action that was turned already is not one from an action of the base's own.
    there = jax.tree.map(lambda leaf: leaf[:4], labels.replace(action=directions.rotate(base, -jnp.deg2rad(60.0))))
    once = dataclasses.replace(SCALARS, k_max=1)
    back = BUNDLE.refine_labelled_actions(model, ENV, there, jnp.ones(4, bool), once).actions
    assert (np.asarray(directions.difference(there.action, back)) > 0).all()


def test_what_the_base_did_is_kept_with_labels_and_told_again_for_labels_from_a_file():
    lanes = product(1, (3,), (20,), (60.0,))
    of = Adaptation(BUNDLE, SIZES, SCALARS, ENV, side_by_side([BASE]))
    start = begin(of, lanes)
    block = start
    for _ in range(2):
        block = ask_round(of, EXPERT, block)
    labels = block.guide.labels
    np.testing.assert_allclose(labels.base, missing(labels.obs), atol=1e-6)
    assert float(DIRECTIONS.distance(labels.base, labels.action).max()) > jnp.deg2rad(
        4.0
    )  # refined ones were asked about
    given = take_labels(of, labels.replace(base=None), start)
    chex.assert_trees_all_close(given.guide.model, block.guide.model, atol=1e-5)


def test_labels_of_other_kinds_keep_no_base_and_training_refuses_this_one():
    lanes = product(1, (3,), (20,), (60.0,))
    plain = registry.make("relative", SIZES, ENV)
    assert begin(Adaptation(plain, SIZES, SCALARS, ENV, side_by_side([BASE])), lanes).guide.labels.base is None
    with pytest.raises(UserError, match="adapt"):
        check_grid(Grid(("relative", "offset"), (0,), (20,)))
    assert "offset" not in registry.possible(ENV, taught=True)
