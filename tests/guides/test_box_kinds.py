"""Kinds of guidance in a box of three, whose goal is known: what teachers with and without faults lead to."""

import dataclasses

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


def distances(kind, rounds=3, **faults):
    """Distances from the goal of 64 uniform actions, and of what a guide makes of them after its labels [shares]."""
    env, scalars = Aimed(), dataclasses.replace(SCALARS, **faults)
    guidance, budget = registry.make(kind, SIZES, env), rounds * SIZES.labels_per_round
    guide = asking.start(guidance, env, budget, budget, jax.random.key(1), jax.random.key(2))
    label_round = probes.label_rounds(guidance, SIZES)
    for _ in range(rounds):
        guide = label_round(env, probes.Expert(env), scalars, Uniform(SMALL), guide, KEY)
    obs, first = jnp.repeat(CONTEXTS, 16, 0), SMALL.sample(KEY, (64,))
    goals = jax.vmap(env.best)(obs)
    acted = jax.jit(guidance.act)(guide.model, env, obs, first, jnp.ones(64, bool), scalars).actions
    np.testing.assert_array_equal(SMALL.retract(acted), acted)
    return tuple(np.asarray(SMALL.distance(actions, goals)) for actions in (first, acted))


def long(*values):
    return pytest.param(*values, marks=pytest.mark.long)


@pytest.mark.parametrize(
    ("kind", "faults", "most"),
    [
        ("intent", {}, 0.06),
        ("relative", {"mistake_probability": 0.1, "silence_probability": 0.3}, 0.1),
        long("relative", {"says": "worst"}, 0.14),  # the worst cue of one round is another one in the next
        long("relative", {"says": "one"}, 0.14),
        long("scalar", {"scalar_within_deg": 0.3}, 0.3),  # by chance a fifth of the actions are good
    ],
)
def test_answers_lead_toward_the_goal(kind, faults, most):
    first, after = distances(kind, **faults)
    assert np.median(first) > 0.35
    assert np.median(after) < most


@pytest.mark.long
def test_a_constant_bias_of_the_teacher_is_learned_along_every_entry():
    """A teacher who holds everything for 0.1 more than it is leads there."""
    _, after = distances("demonstration", teacher_bias_deg=0.1)
    assert np.median(after) == pytest.approx(0.1, abs=0.03)
