"""Every kind of guidance in a box of three, whose goal is known: what teachers with and without faults lead to."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from box_task import SCALARS, SMALL, Reach

from cuelearner_jax import asking
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.environment import Aims
from cuelearner_jax.guides import registry
from cuelearner_jax.policies import Uniform

SIZES = GuideSizes(feedback_layers=(32, 32), labels_per_round=100, fit_steps=400, fit_batch_size=32)
KEY = jax.random.key(3)
CONTEXTS = jnp.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


class Aimed(Reach):
    """The bandit with three aims, of which the second is its goal; the features tell which they are."""

    def aims(self, obs):
        goal = self.best(obs)
        moved = jax.vmap(lambda change: self.actions.exp(goal, change))(jnp.array([[0.3] * 3, [0.0] * 3, [-0.25] * 3]))
        return Aims(moved, jnp.eye(3), jnp.ones(3, bool))


@cache
def away(kind, rounds=3, **faults):
    """Distances from the goal of 64 uniform actions, and of what a guide makes of them after its labels [shares]."""
    env, scalars = Aimed(), dataclasses.replace(SCALARS, **faults)
    guidance = registry.make(kind, SIZES, env)
    slots = rounds * SIZES.labels_per_round if guidance.asks else 0
    guide = asking.start(guidance, env, slots, slots, jax.random.key(1), jax.random.key(2))
    label_round = probes.label_rounds(guidance, SIZES)
    for _ in range(rounds if guidance.asks else 0):
        guide = label_round(env, probes.Expert(env), scalars, Uniform(SMALL), guide, KEY)
    obs, first = jnp.repeat(CONTEXTS, 16, 0), SMALL.sample(KEY, (64,))
    goals = jax.vmap(env.best)(obs)
    acted = jax.jit(guidance.act)(guide.model, env, obs, first, jnp.ones(64, bool), scalars)
    assert np.isfinite(acted.actions).all()
    np.testing.assert_array_equal(SMALL.retract(acted.actions), acted.actions)
    return tuple(np.asarray(SMALL.distance(actions, goals)) for actions in (first, acted.actions))


LONG = [pytest.param(kind, 0.12, marks=pytest.mark.long) for kind in ("bdcoach", "clic", "clic_shown")]
LONG += [pytest.param(kind, 0.3, marks=pytest.mark.long) for kind in ("dcoach", "scalar")]


@pytest.mark.parametrize(
    ("kind", "within"),
    [("demonstration", 0.06), ("intent", 0.06), *LONG],
)
def test_every_kind_that_asks_leads_toward_the_goal_of_a_box(kind, within):
    first, after = away(kind, scalar_within_deg=0.3)  # by chance a fifth of the actions are good
    assert np.median(first) > 0.35
    assert np.median(after) < within


def test_a_kind_that_asks_nothing_leaves_actions_of_a_box_alone():
    first, after = away("none")
    np.testing.assert_array_equal(first, after)


def test_a_share_of_mistakes_and_of_silence_is_survived():
    _, after = away("relative", mistake_probability=0.1, silence_probability=0.3)
    assert np.median(after) < 0.1


@pytest.mark.long
@pytest.mark.parametrize("says", ["worst", "one"])
def test_who_speaks_of_one_cue_at_a_time_leads_there_in_rounds(says):
    """What is asked about follows what is done, so the worst cue of one round is another one in the next."""
    first, after = away("relative", says=says)
    assert np.median(after) < 0.4 * np.median(first)


@pytest.mark.long
def test_a_constant_bias_of_the_teacher_is_learned_along_every_entry():
    """A teacher who holds everything for 0.1 more than it is leads there."""
    _, after = away("demonstration", teacher_bias_deg=0.1)
    assert np.median(after) == pytest.approx(0.1, abs=0.03)
