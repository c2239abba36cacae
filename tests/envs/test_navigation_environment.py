"""Navigation as a task: what is seen, what is paid, how episodes end and begin, and what replay makes of it."""

import math
import re

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_envs.navigation import World
from cuelearner_envs.navigation.config import NavigationConfig, make_environment
from cuelearner_envs.navigation.environment import Navigation, Walker
from cuelearner_envs.navigation.lidar import Lidar
from cuelearner_envs.navigation.robot import collides
from cuelearner_envs.navigation.world import FAR_AWAY
from cuelearner_envs.navigation.worlds import generate_many
from cuelearner_jax import actions, train
from cuelearner_jax import guidance as guidances
from cuelearner_jax.errors import UserError
from cuelearner_jax.types import Environment

KEY = jax.random.key(0)
AHEAD, LEFT, BACK = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]), jnp.array([-1.0, 0.0])
STRIDE = 0.2 - 0.1 * (1 - math.exp(-2))  # the first step from rest: 1 m/s, 0.2 s, a lag of 0.1 s [m]
GOAL, DISTANCE, PREVIOUS = slice(271, 273), 273, slice(274, 280)
FAULTLESS = Lidar(*map(jnp.float32, (10.0, 0.0, 0.0, 0.0)))
FAULTS = Lidar(*map(jnp.float32, (10.0, 0.26, 0.05, 0.1)))

reset_many = jax.jit(lambda env, keys: jax.vmap(env.reset)(keys))
observe = jax.jit(lambda env, state: env.observe(state))
observe_many = jax.jit(lambda env, states: jax.vmap(env.observe)(states))
ranges = jax.jit(lambda env, states: jax.vmap(env.ranges)(states))
recall = jax.jit(lambda env, memory: jax.vmap(env.recall)(memory))
recall_next = jax.jit(lambda env, *parts: jax.vmap(env.recall_next)(*parts))
step_many = jax.jit(lambda env, *parts: jax.vmap(env.step)(jax.random.split(KEY, 200), *parts))


def hall(circles=((FAR_AWAY, FAR_AWAY, 0.01),), starts=((-4.0, 0.0), (-4.0, 2.0)), goals=((4.0, 0.0), (4.0, 2.0))):
    """12 m by 8 m between walls, with columns."""
    walls = [[6.1, 0, 0, 0.1, 4.2], [-6.1, 0, 0, 0.1, 4.2], [0, 4.1, 0, 6.2, 0.1], [0, -4.1, 0, 6.2, 0.1]]
    world = World(
        boxes=jnp.array(walls, jnp.float32),
        box_heights=jnp.full(4, 1.5),
        circles=jnp.array(circles, jnp.float32),
        circle_heights=jnp.ones(len(circles)),
        extent=jnp.array([12.0, 8.0]),
        starts=jnp.array(starts),
        goals=jnp.array(goals),
    )
    return Navigation(worlds=jax.tree.map(lambda leaf: leaf[None], world), max_steps=jnp.int32(200))


def walker(pose, goal=(4.0, 0.0), steps=0, previous=((0.0, 0.0),) * 3, velocity=(0.0, 0.0)):
    pose, velocity, goal, previous = (jnp.array(values, jnp.float32) for values in (pose, velocity, goal, previous))
    zero = jnp.zeros((), jnp.int32)
    return Walker(pose, velocity, goal, previous, world=zero, route=zero, steps=jnp.array(steps, jnp.int32))


HALL = hall()


@jax.jit
def step(env, state, action, key=KEY):
    return env.step(key, state, action)


@jax.jit
def moved(env, state, action):
    return env.moved(state, action)


# Short episodes and wide goals, so that a few dozen steps see every kind of end.
EIGHT = generate_many(jax.random.key(1), 8)  # as many as other tests have compiled
WORLDS = Navigation(
    worlds=jax.tree.map(lambda leaf: leaf[:3], EIGHT),
    lidar=FAULTLESS,
    max_steps=jnp.int32(25),
    goal_radius=jnp.float32(4.5),
)
CHANGED = NavigationConfig("clutter", 8, 5, 17, 0.7, 6.0, 15.0, 0.02, 0.1, True)


# --- observation -----------------------------------------------------------------------------------------------------


def test_the_environment_follows_the_protocol():
    env: Environment = WORLDS
    assert (env.obs_size, env.symmetries, env.replace(mirrors=True).symmetries) == (280, 1, 2)
    state, obs = jax.eval_shape(env.reset, KEY)
    assert (obs.shape, obs.dtype) == ((280,), jnp.float32)
    following, result = jax.eval_shape(env.step, KEY, state, AHEAD)
    assert jax.tree.map(jnp.shape, following) == jax.tree.map(jnp.shape, state)
    assert (result.obs.shape, result.final_obs.shape, result.aftermath.shape) == ((280,), (280,), (3,))


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


def test_everything_is_seen_in_the_bodys_frame():
    seen = np.asarray(observe(HALL, walker((1.0, 0.0, math.pi / 2), (4.0, 4.0))))
    np.testing.assert_allclose(seen[[45, 135, 225]], np.exp([-5.0, -4.0, -7.0]), rtol=1e-4)
    np.testing.assert_allclose(seen[GOAL], [0.8, -0.6], atol=1e-6)  # 3 m to the right and 4 m ahead
    assert seen[DISTANCE] == pytest.approx(5 / 15)


def test_a_beam_that_meets_nothing_in_range_reads_the_range():
    seen = np.asarray(observe(HALL, walker((-5.0, 0.0, 0.0))))
    assert seen[135] == pytest.approx(math.exp(-10))  # the wall stands 11 m away
    near = np.asarray(observe(HALL.replace(lidar=Lidar(max_range=2.0)), walker((-5.0, 0.0, 0.0))))
    np.testing.assert_allclose(near, np.where(np.arange(280) < 271, np.maximum(seen, math.exp(-2)), seen), rtol=1e-5)


def test_on_the_goal_the_observation_is_finite():
    seen = observe(HALL, walker((1.0, 1.0, 0.3), (1.0, 1.0)))
    assert np.isfinite(seen).all()
    assert float(seen[DISTANCE]) == 0


def test_the_heuristic_is_the_goals_direction():
    seen = observe(HALL, walker((1.0, 0.0, math.pi / 2), (4.0, 4.0)))
    np.testing.assert_array_equal(HALL.heuristic(seen), seen[GOAL])


def test_previous_actions_move_up_by_one_each_step():
    state, given = walker((0.0, 0.0, 0.0)), [AHEAD, LEFT, BACK, jnp.array([0.6, -0.8])]
    for count, action in enumerate(given, start=1):
        state, result = step(HALL, state, action)
        latest = [*given[:count][::-1], *[jnp.zeros(2)] * 3][:3]
        np.testing.assert_array_equal(result.obs[PREVIOUS], jnp.concatenate(latest))
        np.testing.assert_array_equal(result.final_obs, result.obs)


# --- reward and ends -------------------------------------------------------------------------------------------------


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
    limit = HALL.robot.replace(turn_rate=jnp.float32(0.0 if turning or action is BACK else 1.5))
    env = HALL.replace(robot=limit)
    place = np.array(pose[:2])
    for slack, collision in ((0.003, False), (-0.003, True)):
        _, result = step(env, walker((*(place + slack * room), pose[2])), action)
        expected = (-10, True, False, nothing() | {"collision": 1}) if collision else (0, False, False, nothing())
        assert outcome(result) == expected


def test_touching_a_column_ends_the_episode():
    env = hall(circles=[[2.0, 0.0, 0.3]])
    near = 2.0 - 0.3 - 0.465 - STRIDE
    assert outcome(step(env, walker((near - 0.003, 0.0, 0.0)), AHEAD)[1])[0] == 0
    assert outcome(step(env, walker((near + 0.003, 0.0, 0.0)), AHEAD)[1])[:3] == (-10, True, False)


def test_a_collision_at_the_goal_is_a_collision():
    _, result = step(HALL, walker((6.0 - 0.465, 0.0, 0.0), (5.6, 0.0)), AHEAD)
    assert outcome(result) == (-10, True, False, nothing() | {"collision": 1})


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
    after = moved(HALL, before, AHEAD)
    state, result = step(HALL, before, AHEAD)
    assert bool(result.terminated)
    np.testing.assert_allclose(result.aftermath, after.pose, atol=1e-6)
    np.testing.assert_allclose(result.final_obs, observe(HALL, after), atol=1e-5)
    np.testing.assert_array_equal(result.final_obs[PREVIOUS], [1, 0, 0, 1, 0, 1])
    np.testing.assert_allclose(result.obs, observe(HALL, state), atol=1e-5)
    np.testing.assert_array_equal(result.obs[PREVIOUS], 0)
    assert float(jnp.abs(result.obs - result.final_obs).max()) > 0.1


# --- episodes --------------------------------------------------------------------------------------------------------


def assert_begun(env, states):
    """All at rest at the start of a route of their world, at its goal's route."""
    states = jax.device_get(states)
    starts, goals = np.asarray(env.worlds.starts), np.asarray(env.worlds.goals)
    np.testing.assert_array_equal(states.pose[:, :2], starts[states.world, states.route])
    np.testing.assert_array_equal(states.goal, goals[states.world, states.route])
    for still in (states.velocity, states.previous, states.steps):
        np.testing.assert_array_equal(still, 0)


def test_episodes_begin_at_rest_at_the_start_of_every_route_turned_any_way():
    states, _ = reset_many(WORLDS, jax.random.split(KEY, 600))
    assert_begun(WORLDS, states)
    routes = np.asarray(states.world * 16 + states.route)
    counts = np.bincount(routes, minlength=48)
    assert counts.min() >= 2  # 12.5 each, standard deviation 3.5
    assert counts.max() <= 28
    quarters = np.histogram(np.asarray(states.pose[:, 2]), 4, (-math.pi, math.pi))[0]
    assert quarters.sum() == 600
    assert quarters.min() > 110  # 150 each, standard deviation 10.6


def test_starts_and_goals_are_free_whichever_way_the_body_is_turned_and_5_to_15_m_apart():
    touches = jax.jit(jax.vmap(jax.vmap(jax.vmap(collides, (None, None, 0)), (None, None, 0)), (None, 0, 0)))
    for places in (WORLDS.worlds.starts, WORLDS.worlds.goals):
        yaws = jnp.linspace(0, math.pi, 9)
        poses = jnp.concatenate(
            [
                jnp.broadcast_to(places[:, :, None], (3, 16, 9, 2)),
                jnp.broadcast_to(yaws[:, None], (3, 16, 9, 1)),
            ],
            -1,
        )
        assert not touches(WORLDS.robot, WORLDS.worlds, poses).any()
    apart = np.linalg.norm(WORLDS.worlds.goals - WORLDS.worlds.starts, axis=-1)
    assert apart.min() >= 5
    assert apart.max() <= 15


@jax.jit
def played(env, key):
    """60 steps of 16 environments that blunder toward their goals: states before, actions, steps, states after."""

    def advance(carry, number):
        states, obs = carry
        k_turn, k_step = jax.random.split(jax.random.fold_in(key, number))
        action = actions.rotate(jax.vmap(env.heuristic)(obs), jax.random.normal(k_turn, (16,)))
        memory = jax.vmap(env.remember)(states, obs)
        following, result = jax.vmap(env.step)(jax.random.split(k_step, 16), states, action)
        return (following, result.obs), (states, obs, memory, action, result, following)

    start = jax.vmap(env.reset)(jax.random.split(key, 16))
    return jax.lax.scan(advance, start, jnp.arange(60))[1]


def flat(tree):
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), tree)


KINDS = {"plain": FAULTLESS, "faulty": FAULTS}


@pytest.fixture(scope="module")
def plays():
    return {name: (env := WORLDS.replace(lidar=lidar), played(env, KEY)) for name, lidar in KINDS.items()}


def test_an_end_is_followed_by_a_new_episode_of_any_world_and_nothing_else_is(plays):
    env, (states, _, _, action, result, following) = plays["plain"]
    ended = np.asarray(result.terminated | result.truncated)
    for end in (result.outcome["success"] > 0, result.outcome["collision"] > 0, result.truncated):
        assert end.sum() >= 5
    assert_begun(env, jax.tree.map(lambda leaf: leaf[ended], following))
    assert len(set(np.asarray(following.world)[ended].tolist())) == 3
    went_on = jax.tree.map(lambda leaf: leaf[~ended], following)
    expected = jax.tree.map(lambda leaf: leaf[~ended], jax.vmap(jax.vmap(env.moved))(states, action))
    chex.assert_trees_all_close(went_on, expected, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(following.steps), np.where(ended, 0, states.steps + 1))


def test_each_step_has_one_end_at_most_and_pays_accordingly(plays):
    _, (_, _, _, _, result, _) = plays["plain"]
    ends = np.stack([np.asarray(result.outcome[name]) for name in ("success", "collision", "timeout")])
    assert set(ends.sum(0).ravel().tolist()) == {0.0, 1.0}
    np.testing.assert_array_equal(result.reward, 10 * ends[0] - 10 * ends[1])
    np.testing.assert_array_equal(result.terminated, ends[0] + ends[1] > 0)
    np.testing.assert_array_equal(result.truncated, ends[2] > 0)


# --- replay ----------------------------------------------------------------------------------------------------------


def lane(env):
    sizes = probes.SIZES
    return train.Lane(sizes, guidances.make("none", sizes, env.obs_size), True, env.obs_size, 0)


@pytest.mark.parametrize("kind", KINDS)
def test_remembered_steps_rebuild_what_was_seen_before_and_after(plays, kind):
    env, played_steps = plays[kind]
    _, obs, memory, action, result, _ = flat(played_steps)
    np.testing.assert_allclose(recall(env, memory), obs, atol=2e-6)
    recalled = recall_next(env, memory, action, result.aftermath)
    np.testing.assert_allclose(recalled, result.final_obs, atol=2e-6)
    ended = np.asarray(result.terminated | result.truncated)
    assert ended.sum() > 20
    assert np.abs(recalled - result.obs)[ended].max(-1).min() > 1e-3  # what a reset shows is something else
    np.testing.assert_array_equal(recalled[:, PREVIOUS], result.final_obs[:, PREVIOUS])


def test_a_faulty_reading_is_made_again_and_not_drawn_again(plays):
    """Beside the test above: the faults are there, and they differ from place to place."""
    faulty, played_steps = plays["faulty"]
    states = flat(played_steps[0])
    turned = faulty.replace(lidar=FAULTLESS.replace(rotation=FAULTS.rotation))
    sensed, true = np.asarray(ranges(faulty, states)), np.asarray(ranges(turned, states))
    lost = (sensed == 10) & (true < 9.5)
    assert lost[true < 9.5].mean() == pytest.approx(0.1, abs=0.005)
    seen = ~lost & (true > 0.3) & (true < 9.5)
    assert np.std((sensed - true)[seen]) == pytest.approx(0.05, rel=0.02)
    assert np.mean((sensed - true)[seen]) == pytest.approx(0, abs=0.001)
    errors = (sensed - true)[:400]
    alike = np.mean(np.abs(errors[:-1] - errors[1:]) < 1e-4, axis=-1)
    assert alike.max() < 0.3
    np.testing.assert_array_equal(ranges(faulty, states), sensed)


def test_a_stored_transition_takes_80_bytes():
    for env in (WORLDS, WORLDS.replace(lidar=FAULTS, mirrors=True)):
        rows = lane(env).buffer(env).empty(10)
        assert rows.nbytes / 10 <= 80


@jax.jit
def through(env, memory, action, result):
    """The last 320 of 960 steps as a ring buffer of that many rows gives them back, oldest first."""
    loop = lane(env)
    buffer = loop.buffer(env)

    def add(rows, item):
        number, *parts = item
        return buffer.add(rows, number * 16, jax.vmap(loop.memory)(*parts)), None

    rows, _ = jax.lax.scan(add, buffer.empty(320), (jnp.arange(60), memory, action, result))
    return loop.one_step(env, buffer.read(rows, jnp.arange(320)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_ring_buffer_gives_back_the_transitions_that_were_made(plays, kind):
    env, (_, obs, memory, action, result, _) = plays[kind]
    found = through(env, memory, action, result)
    obs, action, result = flat(jax.tree.map(lambda leaf: leaf[40:], (obs, action, result)))  # what fits in, in order
    np.testing.assert_allclose(found.obs, obs, atol=2e-6)
    np.testing.assert_allclose(found.next_obs, result.final_obs, atol=2e-6)
    np.testing.assert_array_equal(found.action, action)
    np.testing.assert_array_equal(found.reward, result.reward)
    np.testing.assert_array_equal(found.discount, np.where(result.terminated, 0, 1))
    assert result.truncated.any()
    assert result.terminated.any()


def test_the_number_of_a_world_survives_being_stored():
    for number in (0, 1023, 2**20 + 1):
        memory = HALL.remember(walker((0.0, 0.0, 0.0)).replace(world=jnp.int32(number)), jnp.zeros(280))
        assert memory.dtype == jnp.float32
        assert int(memory[11]) == number


# --- mirrors ---------------------------------------------------------------------------------------------------------


def mirrored_worlds(worlds):
    """Every world with y turned round."""
    flip = jnp.array([1.0, -1.0])
    return worlds.replace(
        boxes=worlds.boxes * jnp.array([1.0, -1.0, -1.0, 1.0, 1.0]),
        circles=worlds.circles * jnp.array([1.0, -1.0, 1.0]),
        starts=worlds.starts * flip,
        goals=worlds.goals * flip,
    )


def mirrored_states(states):
    flip = jnp.array([1.0, -1.0])
    return states.replace(
        pose=states.pose * jnp.array([1.0, -1.0, -1.0]),
        velocity=states.velocity * flip,
        goal=states.goal * flip,
        previous=states.previous * flip,
    )


def test_a_mirrored_world_looks_mirrored_and_a_mirrored_step_leads_to_the_mirrored_place(plays):
    env, played_steps = plays["plain"]
    states, obs, _, action, result, _ = jax.tree.map(lambda leaf: leaf[:200], flat(played_steps))
    image_env = env.replace(worlds=mirrored_worlds(env.worlds))
    image = jax.jit(jax.vmap(env.mirror, (None, 0, 0)))
    expected, image_action = image(1, obs, action)
    # A beam that grazes a corner may see either side of it.
    assert_mostly_close(observe_many(image_env, mirrored_states(states)), expected)
    _, image_result = step_many(image_env, mirrored_states(states), image_action)
    assert_mostly_close(image_result.final_obs, image(1, result.final_obs, action)[0])
    np.testing.assert_array_equal(image_result.reward, result.reward)
    np.testing.assert_array_equal(image_result.terminated, result.terminated)
    assert np.abs(expected - obs).max(-1).min() > 1e-3  # none of these looks like its own image


def assert_mostly_close(found, expected):
    apart = np.abs(np.asarray(found) - np.asarray(expected))
    np.testing.assert_allclose(np.sort(apart, axis=-1)[:, :-2], 0, atol=1e-4)
    assert (apart > 1e-4).mean() < 1e-3


def test_mirroring_twice_or_under_the_identity_changes_nothing(plays):
    _, played_steps = plays["plain"]
    obs, action = flat(played_steps)[1][:50], flat(played_steps)[3][:50]
    image = jax.vmap(WORLDS.mirror, (None, 0, 0))
    chex.assert_trees_all_equal(image(0, obs, action), (obs, action))
    chex.assert_trees_all_equal(image(1, *image(1, obs, action)), (obs, action))
    np.testing.assert_array_equal(image(1, obs, action)[1], action * jnp.array([1.0, -1.0]))


# --- configuration ---------------------------------------------------------------------------------------------------


def test_a_turned_sensor_reads_what_another_beam_read():
    state = walker((1.0, 0.5, 0.3))
    seen = np.asarray(observe(HALL, state))
    turned = np.asarray(
        observe(HALL.replace(lidar=FAULTLESS.replace(rotation=make_environment(CHANGED).lidar.rotation)), state)
    )
    np.testing.assert_allclose(turned[:256], seen[15:271], atol=1e-5)  # beams stand a degree apart
    np.testing.assert_array_equal(turned[271:], seen[271:])


def test_the_robot_walks_as_before_with_a_faulty_sensor(plays):
    states, _, _, action, plain, _ = jax.tree.map(lambda leaf: leaf[:200], flat(plays["plain"][1]))
    _, faulty = step_many(plays["faulty"][0], states, action)
    np.testing.assert_allclose(faulty.aftermath, plain.aftermath, atol=1e-5)
    np.testing.assert_array_equal(faulty.reward, plain.reward)
    assert np.abs(faulty.final_obs - plain.final_obs).max(-1).min() > 1e-3


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


def test_a_configuration_reaches_the_environment():
    env = make_environment(CHANGED)
    assert env.worlds.starts.shape == (8, 16, 2)
    assert (
        np.abs(env.worlds.starts - make_environment(NavigationConfig(worlds=8)).worlds.starts).max() > 0.1
    )  # its seed
    assert (int(env.max_steps), env.mirrors) == (17, True)
    found = [env.goal_radius, env.lidar.max_range, env.lidar.rotation, env.lidar.noise, env.lidar.dropout]
    np.testing.assert_allclose(found, [0.7, 6.0, math.radians(15), 0.02, 0.1], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("style", "maze", "task.style is 'maze': choose one of clutter, rooms, corridor"),
        ("worlds", 0, "task.worlds is 0: give a positive number"),
        ("worlds", 1 << 25, "give at most 16777216"),
        ("max_steps", 0, "task.max_steps is 0: give a positive number"),
        ("goal_radius", -1.0, "task.goal_radius is -1.0: give a positive number"),
        ("max_range", math.inf, "task.max_range is inf: give a positive number"),
        ("lidar_dropout", 2.0, "task.lidar_dropout is 2.0: give a probability from 0 to 1"),
        ("lidar_noise", -0.1, "task.lidar_noise is -0.1: give a number of metres"),
        ("lidar_rotation_deg", math.nan, "task.lidar_rotation_deg is nan: give a finite number"),
    ],
)
def test_what_makes_no_world_is_refused_in_one_line(name, value, words):
    with pytest.raises(UserError, match=re.escape(words)) as refused:
        make_environment(NavigationConfig(**{name: value}))
    assert "\n" not in str(refused.value)


def test_changed_worlds_compile_nothing_new():
    chex.clear_trace_counter()  # it counts by hash, which a function of an earlier test may have had
    counted = jax.jit(chex.assert_max_traces(lambda env, state, action: env.step(KEY, state, action), n=1))
    env = WORLDS.replace(
        robot=jax.tree.map(jnp.float32, WORLDS.robot),
    )
    lidars = [
        env.lidar.replace(**{name: jnp.float32(value)})
        for name, value in (("max_range", 3.0), ("rotation", 0.2), ("noise", 0.1), ("dropout", 0.2))
    ]
    changed = [env, *(env.replace(lidar=lidar) for lidar in lidars)]
    changed += [
        env.replace(worlds=mirrored_worlds(env.worlds)),
        env.replace(robot=env.robot.replace(speed=jnp.float32(0.5))),
        env.replace(max_steps=jnp.int32(1)),
    ]
    state, _ = env.reset(KEY)
    seen = [tuple(np.asarray(counted(one, state, LEFT)[1].obs).tolist()) for one in changed]
    assert len(set(seen)) == len(changed)
