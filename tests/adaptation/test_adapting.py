"""Adaptation on the bandit, whose best direction is known: bounds, recovery, label files, judging."""

import dataclasses
from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.adaptation import by_model, judging
from cuelearner_jax.adaptation.judging import Judging
from cuelearner_jax.adaptation.lanes import Adaptation, Lanes, ask_round, begin, product, rounds, side_by_side
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import BY_LANE, Common, PolicyNode
from cuelearner_jax.spaces import DIRECTIONS, directions
from cuelearner_jax.types import Label

HALF = 6.0  # half the width of the winning window [deg]
ENV = probes.Window(half_width=jnp.deg2rad(jnp.array(HALF)))
EXPERT = probes.Expert(ENV)
SIZES = GuideSizes(feedback_layers=(32, 32), fit_steps=200, fit_batch_size=32)
SCALARS = dataclasses.replace(probes.SCALARS, eps_deg=5.0, tau_deg=0.25)
RELATIVE = guidances.make("relative", SIZES, ENV)
OBS = directions.evenly_spaced(4)
SHIFTS = (-25.0, 40.0)  # by which the base policies miss the best direction [deg]
MESH = lane_mesh(jax.local_devices()[:1])
JUDGING = Judging(ENV, num_envs=15, steps=10)


class Shifted(PolicyNode):
    """Misses the best direction by a constant angle [deg]."""

    shift: jax.Array

    def act(self, key, states, obs):
        return directions.rotate(obs, 0.6 + jnp.deg2rad(self.shift))

    @property
    def axes(self):
        return self.replace(shift=BY_LANE)


BASES = side_by_side([Shifted(jnp.array(shift)) for shift in SHIFTS])
LANES = product(2, (3,), (30, 80), (10.0, 60.0))


def of(bases=BASES):
    return Adaptation(RELATIVE, SIZES, SCALARS, ENV, bases)


@cache
def found():
    """All lanes."""
    return by_model.adapt(of(), LANES, JUDGING, EXPERT, mesh=MESH)


# In one program each, as all lanes have the same shapes.
distance = jax.jit(DIRECTIONS.distance)
acted = jax.jit(lambda policy, obs: policy.act(jax.random.key(0), None, obs))


def apart(one, other):
    """How far actions lie from others [deg]."""
    return np.degrees(np.asarray(distance(one, other)))


def errors(policy, lane):
    """How far a lane's actions lie from the best ones, over all observations [deg]."""
    return apart(acted(policy.lane(lane), OBS), directions.rotate(OBS, 0.6))


def test_lanes_are_every_combination_or_one_each():
    assert LANES.number == 8
    every = {(base, 3, budget, bound) for base in (0, 1) for budget in (30, 80) for bound in (10.0, 60.0)}
    assert {*zip(*(column.tolist() for column in LANES), strict=True)} == every
    each = product(3, (4, 7, 9), (30,), (60.0,), one_each=True)
    assert (each.base.tolist(), each.seed.tolist()) == ([0, 1, 2], [4, 7, 9])


def test_a_constant_shift_is_recovered_to_within_eps():
    policy = found().policy(ENV)
    for lane in np.flatnonzero((LANES.budget == 80) & (LANES.bound_deg == 60)):
        assert errors(policy, lane).max() < SCALARS.eps_deg
    judged = found().judgement
    np.testing.assert_array_equal(judged.in_use, judged.after > 0.2)  # a lane that may not go far enough is no better
    np.testing.assert_array_equal(judged.before, 0.0)
    assert judged.after[(LANES.budget == 80) & (LANES.bound_deg == 60)].min() == 1.0
    np.testing.assert_allclose(judged.difference[:, 0], judged.after - judged.before, atol=1e-6)
    assert (judged.difference[:, 1] <= judged.difference[:, 0]).all()
    assert set(judged.rewarded_steps.tolist()) == {2 * 15 * JUDGING.steps}  # before and after


def test_the_bound_is_never_exceeded():
    fitted = found().block.guide
    block = found().block.replace(guide=fitted.replace(model=fitted.model.replace(fitted=jnp.ones(8, bool))))
    policy, labels = of().policy(block), found().labels  # used or not
    for lane, bound in enumerate(LANES.bound_deg):
        base = Shifted(jnp.array(SHIFTS[LANES.base[lane]]))
        moved = apart(acted(base, OBS), acted(policy.lane(lane), OBS))
        assert moved.max() <= bound + 1e-3
        if bound == 10:  # too near to be right: as far as it may go
            np.testing.assert_allclose(moved, bound, atol=0.5)
        rows = jax.tree.map(lambda leaf, lane=lane: leaf[lane][labels.valid[lane]], labels)
        away = apart(acted(base, rows.obs), rows.action)
        assert away.max() <= bound + 1e-3
        assert away[:10].max() < 1e-3  # the first round is about its own actions
        assert away[10:].max() > 4.0  # later ones about refined ones
    # However wild the model.
    policy = of().policy(block.replace(guide=block.guide.replace(model=jax.tree.map(_blown, block.guide.model))))
    everywhere = directions.evenly_spaced(100)
    for lane, bound in enumerate(LANES.bound_deg):
        base = Shifted(jnp.array(SHIFTS[LANES.base[lane]]))
        moved = apart(acted(base, everywhere), acted(policy.lane(lane), everywhere))
        assert moved.max() <= bound + 1e-3
        assert moved.max() > bound / 2


def _blown(leaf):
    return leaf * 30 if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def test_budgets_are_masks_and_lanes_do_not_know_each_other():
    labels, block = found().labels, found().block
    assert labels.valid.sum(-1).tolist() == LANES.budget.tolist()
    for lane in np.flatnonzero(LANES.budget == 30):
        alike = (LANES.bound_deg == LANES.bound_deg[lane]) & (LANES.base == LANES.base[lane])
        (larger,) = np.flatnonzero((LANES.budget == 80) & alike)
        first = jax.tree.map(lambda leaf, lane=lane: leaf[lane][:30], labels)
        chex.assert_trees_all_equal(first, jax.tree.map(lambda leaf, lane=larger: leaf[lane][:30], labels))
    lane = 5
    own = side_by_side([Shifted(jnp.array(SHIFTS[LANES.base[lane]]))])
    one = Lanes(*(column[[lane]] for column in LANES))._replace(base=np.zeros(1, np.int32))
    alone = begin(of(own), one)
    for _ in range(rounds(one, SIZES)):
        alone = ask_round(of(own), EXPERT, alone, MESH)
    kept = jax.tree.map(lambda leaf: leaf[lane], block.guide.model)
    chex.assert_trees_all_equal(jax.tree.map(lambda leaf: leaf[0], alone.guide.model), kept)


def test_given_labels_lead_where_asking_for_them_did():
    given = by_model.adapt(of(), LANES, JUDGING, labels=found().labels, mesh=MESH)
    chex.assert_trees_all_equal(given.block.guide.model, found().block.guide.model)
    np.testing.assert_array_equal(given.judgement.after, found().judgement.after)


def own_labels(shift, count, answer=1.0):
    """Answers about a policy's own actions alone, padded to whole rounds."""
    obs = OBS[np.arange(count) % 4]
    action = Shifted(jnp.array(shift)).act(None, None, obs)
    rows = Label(obs, action, jnp.full((count, 1), answer), jnp.ones(count, bool))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], rows)


def test_without_a_simulator_held_out_answers_decide():
    how = dataclasses.replace(JUDGING, env=None, by="labels")
    lanes = product(1, (0, 1), (40,), (10.0,))
    base = Common(Shifted(jnp.array(-25.0)))
    one = own_labels(-25.0, 40)
    chance = np.random.default_rng(1).choice([-1.0, 0.0, 0.0, 0.0, 1.0], (1, 40, 1)).astype(np.float32)
    both = jax.tree.map(lambda *leaves: np.concatenate(leaves), one, one.replace(answer=chance))
    judged = by_model.adapt(of(base), lanes, how, labels=both, mesh=MESH).judgement
    assert judged.by == "labels"
    assert judged.rewarded_steps.tolist() == [0, 0]
    assert (judged.before[0], judged.after[0], judged.in_use[0]) == (0.0, 1.0, True)
    assert judged.before[1] == pytest.approx((chance[0, 3::5, 0] == 0).mean())
    assert judged.after[1] <= judged.before[1]
    few = begin(of(), product(1, (0,), (4,), (10.0,)))
    with pytest.raises(UserError, match="fewer than 5 labels"):
        judging.judge_by_labels(of(), few)


@pytest.mark.long
def test_a_bound_is_narrowed_where_that_is_worth_more():
    """The same answer always, about a policy that is 2 degrees outside of the window."""
    lanes = product(1, (0,), (40,), (60.0,))
    base = Common(Shifted(jnp.array(-8.0)))
    wide, narrow = (
        by_model.adapt(of(base), lanes, dataclasses.replace(JUDGING, bounds=shares), labels=own_labels(-8.0, 40))
        for shares in ((), (0.5, 0.05))
    )
    assert (wide.judgement.before[0], wide.judgement.after[0], wide.judgement.in_use[0]) == (0.0, 0.0, False)
    assert wide.judgement.within_deg.tolist() == pytest.approx([60.0])
    assert (narrow.judgement.after[0], narrow.judgement.in_use[0]) == (1.0, True)
    assert narrow.judgement.within_deg.tolist() == pytest.approx([3.0])
    episodes = 3 * 15 + 2 * 10, 2 * 15  # the three bounds, then pairs until the test decides
    spent = narrow.judgement.rewarded_steps[0], wide.judgement.rewarded_steps[0]
    assert spent == tuple(count * JUDGING.steps for count in episodes)
    assert errors(narrow.policy(ENV), 0) == pytest.approx(5.0, abs=0.01)


@pytest.mark.parametrize(
    ("bounds", "changes", "says"),
    [
        ([0.0], {}, "bound_deg is 0"),
        ([0.3], {}, "labels of 5 degrees say nothing within a bound of 0.3"),
        ([10.0], {"eps_deg": 0.2}, "give scalars.tau_deg 0.01"),
    ],
)
def test_angles_that_do_not_go_together_are_refused(bounds, changes, says):
    with pytest.raises(UserError, match=says):
        by_model.check_amounts(DIRECTIONS, bounds, dataclasses.replace(SCALARS, **changes))
