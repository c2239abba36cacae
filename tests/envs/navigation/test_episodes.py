"""Navigation over whole episodes: how they end and begin, what replay makes of them, and their mirror images."""

from functools import cache

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.navigation.environment import Navigation
from cuelearner_envs.navigation.lidar import Lidar
from cuelearner_envs.navigation.worlds import generate_many
from cuelearner_jax.spaces import directions

KEY = jax.random.key(0)
LEFT = jnp.array([0.0, 1.0])
PREVIOUS = slice(274, 280)
FAULTLESS = Lidar(*map(jnp.float32, (10.0, 0.0, 0.0, 0.0)))
FAULTS = Lidar(*map(jnp.float32, (10.0, 0.26, 0.05, 0.1)))

reset = jax.jit(lambda env, key: env.reset(key))
observe_many = jax.jit(lambda env, states: jax.vmap(env.observe)(states))
ranges = jax.jit(lambda env, states: jax.vmap(env.ranges)(states))
recall = jax.jit(lambda env, memory: jax.vmap(env.recall)(memory))
recall_next = jax.jit(lambda env, *parts: jax.vmap(env.recall_next)(*parts))
step_many = jax.jit(lambda env, *parts: jax.vmap(env.step)(jax.random.split(KEY, 200), *parts))


@cache
def worlds():
    """Short episodes and wide goals, so that a few dozen steps see every kind of end."""
    eight = generate_many(jax.random.key(1), 8)  # as many as other tests have compiled
    return Navigation(
        worlds=jax.tree.map(lambda leaf: leaf[:3], eight),
        lidar=FAULTLESS,
        max_steps=jnp.int32(25),
        goal_radius=jnp.float32(4.5),
    )


def assert_begun(env, states):
    """All at rest at the start of a route of their world, at its goal's route."""
    states = jax.device_get(states)
    starts, goals = np.asarray(env.worlds.starts), np.asarray(env.worlds.goals)
    np.testing.assert_array_equal(states.pose[:, :2], starts[states.world, states.route])
    np.testing.assert_array_equal(states.goal, goals[states.world, states.route])
    for still in (states.velocity, states.previous, states.steps):
        np.testing.assert_array_equal(still, 0)


@jax.jit
def played(env, key):
    """60 steps of 16 environments that blunder toward their goals: states before, actions, steps, states after."""

    def advance(carry, number):
        states, obs = carry
        k_turn, k_step = jax.random.split(jax.random.fold_in(key, number))
        action = directions.rotate(jax.vmap(env.heuristic)(obs), jax.random.normal(k_turn, (16,)))
        memory = jax.vmap(env.remember)(states, obs)
        following, result = jax.vmap(env.step)(jax.random.split(k_step, 16), states, action)
        return (following, result.obs), (states, obs, memory, action, result, following)

    return jax.lax.scan(advance, jax.vmap(env.reset)(jax.random.split(key, 16)), jnp.arange(60))[1]


def flat(tree):
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), tree)


KINDS = {"plain": FAULTLESS, "faulty": FAULTS}


@pytest.fixture(scope="module")
def plays():
    return {name: (env := worlds().replace(lidar=lidar), played(env, KEY)) for name, lidar in KINDS.items()}


def test_an_end_is_followed_by_a_new_episode_of_any_world_and_nothing_else_is(plays):
    env, (states, _, _, action, result, following) = plays["plain"]
    ended = np.asarray(result.terminated | result.truncated)
    for end in (result.outcome["success"] > 0, result.outcome["collision"] > 0, result.truncated):
        assert end.sum() >= 5
    assert_begun(env, jax.tree.map(lambda leaf: leaf[ended], following))
    assert len(set(np.asarray(following.world)[ended].tolist())) == 3
    expected = jax.tree.map(lambda leaf: leaf[~ended], jax.vmap(jax.vmap(env.move))(states, action))
    chex.assert_trees_all_close(jax.tree.map(lambda leaf: leaf[~ended], following), expected, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(following.steps), np.where(ended, 0, states.steps + 1))


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


SIGNS = jnp.array([1.0, -1.0, -1.0, 1.0, 1.0])  # of x, y, yaw and two lengths when left and right are exchanged


def mirrored_worlds(worlds):
    """Every world with y turned round."""
    return worlds.replace(
        boxes=worlds.boxes * SIGNS[None, None],
        circles=worlds.circles * SIGNS[None, None, jnp.array([0, 1, 3])],
        starts=worlds.starts * SIGNS[None, None, :2],
        goals=worlds.goals * SIGNS[None, None, :2],
    )


def mirrored_states(states):
    return states.replace(
        pose=states.pose * SIGNS[None, :3],
        velocity=states.velocity * SIGNS[None, :2],
        goal=states.goal * SIGNS[None, :2],
        previous=states.previous * SIGNS[None, None, :2],
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


def test_changed_worlds_compile_nothing_new():
    chex.clear_trace_counter()  # it counts by hash, which a function of an earlier test may have had
    counted = jax.jit(chex.assert_max_traces(lambda env, state, action: env.step(KEY, state, action), n=1))
    env = worlds().replace(robot=jax.tree.map(jnp.float32, worlds().robot))
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
    state, _ = reset(env, KEY)
    assert len({tuple(np.asarray(counted(one, state, LEFT)[1].obs).tolist()) for one in changed}) == len(changed)
