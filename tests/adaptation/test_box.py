"""Adaptation in a box of three: a policy that misses its goal by a constant change, corrected within a bound."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from box_task import GRIPPER, SCALARS, Reach

from cuelearner_jax.adaptation import by_model, lanes
from cuelearner_jax.adaptation.judging import Judging
from cuelearner_jax.adaptation.lanes import Adaptation
from cuelearner_jax.config import GuideSizes
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import PolicyNode

ENV = Reach(GRIPPER)
SIZES = GuideSizes(feedback_layers=(32, 32), labels_per_round=25, fit_steps=400, fit_batch_size=32)
MISS = jnp.array([0.2, -0.15, 0.2])  # shares
LANES = lanes.product(1, (3,), (200,), (0.1, 0.5))
OBS = jnp.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


class Missing(PolicyNode):
    """Does what would be best, but for a constant change."""

    change: jax.Array

    def act(self, key, states, obs):
        return GRIPPER.exp(jax.vmap(ENV.best)(obs), self.change)


@cache
def found():
    scalars = dataclasses.replace(SCALARS, eps_deg=0.08)
    guidance = guidances.make("relative", SIZES, ENV)
    judging = Judging(ENV, num_envs=20, steps=40)
    asked = Adaptation(guidance, SIZES, scalars, ENV, lanes.side_by_side([Missing(MISS)]))
    return by_model.adapt(asked, LANES, judging, probes.Expert(ENV), mesh=lane_mesh(jax.local_devices()[:1]))


def acted(lane):
    return found().policy(ENV).lane(lane).act(jax.random.key(0), None, OBS)


def test_a_constant_miss_is_recovered_to_within_the_width_of_the_goal():
    left = np.asarray(GRIPPER.distance(acted(1), jax.vmap(ENV.best)(OBS)))
    assert np.sort(left)[2] < 0.1  # in three contexts of four
    judged = found().judged
    assert judged.before[1] == 0.0
    assert judged.after[1] > 0.6
    assert judged.used[1]


def test_no_entry_leaves_the_bound():
    base = Missing(MISS).act(None, None, OBS)
    for lane, bound in enumerate((0.1, 0.5)):
        moved = np.abs(GRIPPER.log(base, acted(lane)))
        assert moved.max() <= bound + 1e-5
    labels = jax.tree.map(lambda leaf: np.asarray(leaf)[0], found().labels)
    asked = GRIPPER.distance(Missing(MISS).act(None, None, jnp.asarray(labels.obs)), labels.action)
    assert np.asarray(asked)[labels.valid].max() == pytest.approx(0.1, abs=1e-4)
