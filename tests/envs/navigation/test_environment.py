"""Navigation as a task: what is seen, what is paid, how an episode ends, and what a configuration changes."""

import math
import re

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rooms

from cuelearner_envs.navigation.config import NavigationConfig, make_environment
from cuelearner_envs.navigation.environment import Navigation, Walker
from cuelearner_jax.errors import UserError

KEY = jax.random.key(0)
AHEAD, LEFT, BACK = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]), jnp.array([-1.0, 0.0])
STRIDE = 0.2 - 0.1 * (1 - math.exp(-2))  # the first step from rest: 1 m/s, 0.2 s, a lag of 0.1 s [m]
GOAL, DISTANCE, PREVIOUS = slice(271, 273), 273, slice(274, 280)

observe = jax.jit(lambda env, state: env.observe(state))


def hall(circles=(), starts=((-4.0, 0.0), (-4.0, 2.0)), goals=((4.0, 0.0), (4.0, 2.0))):
    """12 m by 8 m between walls, with columns."""
    made = rooms.world(rooms.walls(12.0, 8.0), circles, (12.0, 8.0), starts, goals, heights=1.5)
    return Navigation(worlds=jax.tree.map(lambda leaf: leaf[None], made), max_steps=jnp.int32(200))


def walker(pose, goal=(4.0, 0.0), steps=0, previous=((0.0, 0.0),) * 3, velocity=(0.0, 0.0)):
    pose, velocity, goal, previous = (jnp.array(values, jnp.float32) for values in (pose, velocity, goal, previous))
    zero = jnp.zeros((), jnp.int32)
    return Walker(pose, velocity, goal, previous, world=zero, route=zero, steps=jnp.array(steps, jnp.int32))


HALL = hall()


@jax.jit
def step(env, state, action, key=KEY):
    return env.step(key, state, action)


@jax.jit
def move(env, state, action):
    return env.move(state, action)


def test_the_observation_is_nearness_then_the_goals_direction_and_distance_then_actions():
    previous = [[0.6, 0.8], [-1.0, 0.0], [0.0, -1.0]]
    seen = np.asarray(observe(HALL, walker((1.0, 0.0, 0.0), (1.0, 3.0), previous=previous)))
    # Beams stand a degree apart, from -135 to +135: right, ahead and left are 45, 135 and 225.
    np.testing.assert_allclose(seen[[45, 135, 225]], np.exp([-4.0, -5.0, -4.0]), rtol=1e-4)
    np.testing.assert_allclose(seen[[0, 270]], math.exp(-4 * math.sqrt(2)), rtol=1e-4)  # askew to the side walls
    np.testing.assert_allclose(seen[135 + 30], math.exp(-5 / math.cos(math.radians(30))), rtol=1e-4)
    np.testing.assert_allclose(seen[GOAL], [0, 1], atol=1e-6)  # to the left
    assert seen[DISTANCE] == pytest.approx(3 / 15)
    np.testing.assert_allclose(seen[PREVIOUS], np.ravel(previous), atol=1e-7)


AHEAD_OF_IT, SEEN_GOAL, SEEN_PREVIOUS = 180, slice(360, 362), slice(362, 368)
TURNED = walker((0.3, -0.2, 0.4), previous=((1.0, 0.0), (0.0, 1.0), (0.6, 0.8)))


def degrees(angle):
    return jnp.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])


@jax.jit
def features(env, obs, actions):
    return env.features(obs, actions)


def test_features_turn_what_is_seen_to_the_direction():
    obs = observe(HALL, TURNED)
    left = features(HALL, obs, LEFT).turned
    np.testing.assert_allclose(left[AHEAD_OF_IT], obs[135 + 90], atol=1e-5)
    np.testing.assert_allclose(left[AHEAD_OF_IT - 90], obs[135], atol=1e-5)  # what lies ahead is on the right of it
    np.testing.assert_allclose(left[SEEN_PREVIOUS], [0, -1, 1, 0, 0.8, -0.6], atol=1e-5)
    half = features(HALL, obs, degrees(20.5)).turned
    np.testing.assert_allclose(half[AHEAD_OF_IT], (obs[155] + obs[156]) / 2, atol=1e-4)
    np.testing.assert_allclose(half[SEEN_GOAL.start], float(jnp.dot(obs[GOAL], degrees(20.5))), atol=1e-5)


def outcome(result):
    named = {name: round(float(value), 5) for name, value in result.outcome.items()}
    return float(result.reward), bool(result.terminated), bool(result.truncated), named


def nothing(seconds=0.2):
    return {"success": 0, "collision": 0, "timeout": 0, "duration": seconds}


def test_the_goal_is_reached_within_its_radius():
    state, result = step(HALL, walker((0.0, 0.0, 0.0), (0.5 + STRIDE - 0.003, 0.0)), AHEAD)
    assert outcome(result) == (10, True, False, nothing() | {"success": 1})
    assert int(state.steps) == 0
    state, result = step(HALL, walker((0.0, 0.0, 0.0), (0.5 + STRIDE + 0.003, 0.0)), AHEAD)
    assert outcome(result) == (0, False, False, nothing())
    assert float(result.metrics["speed"]) == pytest.approx(STRIDE / 0.2, rel=1e-4)
    np.testing.assert_allclose(state.pose, [STRIDE, 0, 0], atol=1e-5)
    assert int(state.steps) == 1
    wide = HALL.replace(goal_radius=jnp.float32(1.0))
    assert outcome(step(wide, walker((0.0, 0.0, 0.0), (1.0 + STRIDE - 0.003, 0.0)), AHEAD)[1])[0] == 10


@pytest.mark.parametrize(
    ("pose", "action", "room"),
    [
        ((6.0 - 0.465 - STRIDE, 0.0, 0.0), AHEAD, (-1, 0)),  # its front, 0.465 m from the middle, against a wall
        ((-6.0 + 0.465 + STRIDE, 0.0, 0.0), BACK, (1, 0)),  # its back
        ((0.0, 4.0 - 0.265 - STRIDE, math.pi), -LEFT, None),  # its side as it begins to turn: less room than 0.465
    ],
)
def test_touching_a_wall_ends_the_episode(pose, action, room):
    turning = room is None
    room = np.array([0, -1]) if turning else np.array(room)
    env = HALL.replace(robot=HALL.robot.replace(turn_rate=jnp.float32(0.0 if turning or action is BACK else 1.5)))
    place = np.array(pose[:2])
    for slack, collision in ((0.003, False), (-0.003, True)):
        _, result = step(env, walker((*(place + slack * room), pose[2])), action)
        expected = (-10, True, False, nothing() | {"collision": 1}) if collision else (0, False, False, nothing())
        assert outcome(result) == expected


def test_time_runs_out_after_the_last_step_and_is_told_from_termination():
    env = HALL.replace(max_steps=jnp.int32(7))
    state = walker((-3.0, 0.0, 0.0))
    for count in range(1, 8):
        state, result = step(env, state, AHEAD)
        ended = nothing(round(0.2 * count, 5)) | {"timeout": float(count == 7)}
        assert outcome(result) == (0, False, count == 7, ended)
    assert int(state.steps) == 0
    for goal, reward in (((0.5, 0.0), 10), ((4.0, 0.0), 0)):
        _, result = step(env, walker((0.0, 0.0, 0.0), goal, steps=6), AHEAD)
        assert outcome(result)[:3] == (reward, reward == 10, reward == 0)
    _, result = step(env, walker((5.5, 0.0, 0.0), steps=6), AHEAD)
    assert outcome(result)[:3] == (-10, True, False)


def test_the_last_observation_is_of_where_the_step_led_and_the_next_of_a_new_start():
    before = walker((1.0, -1.0, 0.4), (1.5, -1.0), steps=8, previous=[[0.0, 1.0]] * 3)
    after = move(HALL, before, AHEAD)
    state, result = step(HALL, before, AHEAD)
    assert bool(result.terminated)
    np.testing.assert_allclose(result.aftermath, after.pose, atol=1e-6)
    np.testing.assert_allclose(result.final_obs, observe(HALL, after), atol=1e-5)
    np.testing.assert_array_equal(result.final_obs[PREVIOUS], [1, 0, 0, 1, 0, 1])
    np.testing.assert_allclose(result.obs, observe(HALL, state), atol=1e-5)
    np.testing.assert_array_equal(result.obs[PREVIOUS], 0)
    assert float(jnp.abs(result.obs - result.final_obs).max()) > 0.1


def test_every_split_has_worlds_of_its_own_and_always_the_same():
    config = NavigationConfig(worlds=8)
    splits = {name: make_environment(config, name).worlds for name in ("training", "validation", "tuning")}
    boxes = np.concatenate([np.asarray(worlds.boxes) for worlds in splits.values()])
    starts = np.concatenate([np.asarray(worlds.starts) for worlds in splits.values()])
    for one in range(len(boxes)):
        for other in range(one):
            assert np.abs(boxes[one, 4:12] - boxes[other, 4:12]).max() > 0.1
            assert np.abs(starts[one] - starts[other]).max() > 0.1
    chex.assert_trees_all_equal(splits["training"], make_environment(config).worlds)
    other = make_environment(NavigationConfig(worlds=8, world_seed=1)).worlds
    assert np.abs(other.boxes - splits["training"].boxes)[:, 4:12].max((1, 2)).min() > 0.1


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("style", "maze", "task.style is 'maze': choose one of clutter, rooms, corridor"),
        ("lidar_dropout", 2.0, "task.lidar_dropout is 2.0: give a number from 0 to 1"),
        ("preferred_side", "rigth", "task.preferred_side is 'rigth', did you mean 'right'?"),
        ("preferred_side", "left", "task.preferred_side is left: that needs --task.style corridor"),
    ],
)
def test_what_makes_no_world_is_refused_in_one_line(name, value, words):
    with pytest.raises(UserError, match=re.escape(words)) as refused:
        make_environment(NavigationConfig(**{name: value}))
    assert "\n" not in str(refused.value)
