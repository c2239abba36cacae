"""Where two legs lead: scenes whose best second leg is known by hand, and laws of geometry."""

import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rooms

from cuelearner_envs.navigation.aims import RADII, SCALE, WAYS, aims_of
from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_envs.navigation.lidar import scan
from cuelearner_envs.navigation.worlds import FARTHEST
from cuelearner_jax.adaptation.lanes import Lanes
from cuelearner_jax.config import GuideSizes, to_json
from cuelearner_jax.errors import UserError
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs.adapted import AdaptedLanes
from cuelearner_jax.runs.policy_sources import PolicySource
from cuelearner_jax.tasks import registry

PLAINLY = 45  # features of a way without look-ahead
POSE = jnp.zeros(3)
RADIUS = RADII[2]

told = jax.jit(lambda obs: aims_of(obs, True))


def seen(ranges, goal):
    """An observation: what beams read [m], and where the goal lies in the body's frame [m]."""
    goal = np.asarray(goal, float)
    away = np.hypot(*goal)
    return jnp.concatenate([jnp.exp(-ranges), jnp.array([*(goal / away), away / FARTHEST]), jnp.zeros(6)])


def among(boxes, goal, pose=POSE):
    """What is seen among boxes (x, y, yaw, half-length, half-width) from a pose, of a goal in the body's frame."""
    return seen(scan(rooms.world(boxes), pose), goal)


def ahead(obs):
    """By direction, counted from the goal's in steps of 5 degrees: what is left, detour, first leg [m]."""
    features = np.asarray(told(obs).features)
    assert features.shape == (WAYS, PLAINLY + 3)
    return features[:, PLAINLY:].T * SCALE


# 3 m ahead a wall with a doorway from y = 1.5 to 3.5; the goal lies 6 m straight ahead.
DOORWAY = [[3.0, -4.25, 0, 0.1, 5.75], [3.0, 8.75, 0, 0.1, 5.25]]


def test_the_way_to_a_doorway_leads_on_and_the_wall_does_not():
    left, detour, leg = ahead(among(DOORWAY, (6.0, 0.0)))
    to_gap = round(math.degrees(math.atan2(2.5, 3.0)) / 5)  # 40 degrees
    assert left[to_gap] < 0.1
    assert leg[to_gap] > 3.4  # past the wall
    # At the least round the near edge, a radius off it; through the middle 3.91 + 3.91 - 6 m.
    assert 2 * math.hypot(3.0, 1.5 + RADIUS) - 6.0 < detour[to_gap] < 1.81 + 0.1
    # Straight at the wall the second leg is at best 60 degrees aside along it: what is left is beyond.
    assert left[0] > 2.0
    assert left[-to_gap] > 2.0
    assert left[np.r_[0 : to_gap - 3, -to_gap:0]].min() > left[to_gap] + 1.0


def test_what_is_seen_of_a_wall_stops_a_second_leg_and_what_is_not_seen_does_not():
    """Behind a screen the free-space assumption holds: the hidden wall counts only for who sees it."""
    goal, screen, hidden = (6.5, 0.0), [3.0, 0.0, 0, 0.1, 1.0], [5.0, 0.0, 0, 0.1, 1.6]
    one, other, seen_too = (ahead(among(boxes, goal)) for boxes in ([screen], [screen, hidden], [hidden]))
    np.testing.assert_array_equal(one, other)
    beside = [-6, 6]  # 30 degrees either way, past the screen
    np.testing.assert_allclose(one[0][beside], 0.0, atol=1e-3)
    assert one[1][beside].max() < seen_too[1][beside].min()


def world(**changes):
    return NavigationConfig(worlds=1, **changes)


def kept(guidance, look_ahead):
    """A policy folder, as it is known without its arrays."""
    own = {"sizes": to_json(GuideSizes()), "options": {"aim_layers": (8,), "aim_doubt": 2.0}}
    layer = {"policy": "guided", "guidance": guidance, **own, "bounded": True, "base": {"policy": "uniform"}}
    adapted = AdaptedLanes(Path(), {"policy": layer}, Lanes(*(np.zeros(1),) * 4), np.ones(1, bool), None, None)
    config = RunConfig(world(look_ahead=look_ahead))
    return PolicySource(registry.find("navigation"), config, None, Path(), adapted=adapted)


@pytest.mark.parametrize("policy", ["adapted", "base"])
def test_who_weighs_ways_is_refused_where_they_tell_something_else(policy):
    for before in (False, True):
        source = kept("intent", before)
        source.check(policy, world(look_ahead=before))
        with pytest.raises(UserError, match=f"uses aims of {PLAINLY + 3 * before} features"):
            source.check(policy, world(look_ahead=not before))
    kept("relative", False).check(policy, world(look_ahead=True))  # who asks nothing of ways does not mind
