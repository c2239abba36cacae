"""Navigation by the quadruped: the contract of the simple robot's environment, its sensor, C MuJoCo's own episodes."""

import math

import jax
import jax.numpy as jnp
import mujoco
import mujoco_world
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cuelearner_envs.anymal import judged
from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.environment import make_environment
from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_envs.navigation.lidar import scan_tilted
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.spaces import directions

WALKERS = 4
CONFIG = NavigationConfig(worlds=8, max_steps=3)

begin = jax.jit(lambda env, keys: jax.vmap(env.reset)(keys))
look = jax.jit(scan_tilted)


@pytest.fixture(scope="module")
def env():
    return make_environment(CONFIG)


@pytest.fixture(scope="module")
def walked(env):
    """Four quadrupeds after two steps straight ahead: one usual, one at its goal, one in a wall, one on its side."""
    state, _ = begin(env, jax.random.split(jax.random.key(0), WALKERS))
    qpos = np.array(state.body.qpos)
    qpos[2, 0] = 50.0
    qpos[3, 3:7] = np.cos(0.8), np.sin(0.8), 0, 0
    goal = state.goal.at[1].set(state.body.qpos[1, :2])
    state = state.replace(body=state.body.replace(qpos=jnp.asarray(qpos)), goal=goal)
    told = jnp.tile(jnp.array([1.0, 0.0]), (WALKERS, 1))
    step = jax.jit(jax.vmap(env.step))
    keys = jax.random.split(jax.random.key(1), WALKERS)
    following, first = step(keys, state, told)
    _, second = step(keys, following, told)
    return [state, following], [first, second]


@pytest.mark.long
def test_every_end_has_its_name(walked):
    _, (first, _) = walked
    outcome = {name: np.asarray(value).tolist() for name, value in first.outcome.items() if name != "duration"}
    assert outcome == {
        "success": [0, 1, 0, 0],
        "collision": [0, 0, 1, 0],
        "fall": [0, 0, 0, 1],
        "timeout": [0, 0, 0, 0],
    }
    np.testing.assert_allclose(first.reward, [0, 10, -10, -10])
    assert np.asarray(first.terminated).tolist() == [False, True, True, True]


@pytest.mark.long
def test_replay_recalls_what_was_seen(env, walked):
    states, steps = walked
    state = jax.tree.map(lambda leaf: leaf[0], states[1])
    seen = steps[0].obs[0]
    memory = env.remember(state, seen)
    np.testing.assert_allclose(jax.jit(env.recall)(memory), seen, atol=1e-6)
    after = jax.jit(env.recall_next)(memory, jnp.array([1.0, 0.0]), steps[1].aftermath[0])
    np.testing.assert_allclose(after, steps[1].final_obs[0], atol=1e-6)


@pytest.mark.long
def test_commands_lead_where_the_direction_points(env, walked):
    body = jax.tree.map(lambda leaf: leaf[0], walked[0][0].body)
    yaw = robot.planar_pose(body.qpos)[2]
    for turn, turning in ((0.0, 0.0), (0.15, 0.5), (1.0, 1.5), (-2.0, -1.5)):
        wanted = np.array([math.cos(turn), math.sin(turn), turning])
        heading = directions.from_angle(yaw + turn)
        np.testing.assert_allclose(env.command(body, jnp.asarray(wanted), heading), wanted, atol=1e-4)
        told = jnp.zeros(3)
        for _ in range(10):  # the steps of control of 0.2 s, in which the bounds allow 1.6 m/s and 4 rad/s
            told = env.command(body, told, heading)
        np.testing.assert_allclose(told, wanted, atol=1e-4)


def tilted(yaw=0.0, pitch=0.0, roll=0.0):
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix().astype(np.float32)


def test_a_tilted_sensor_reads_what_mujocos_rays_do(env):
    rng, equal = np.random.default_rng(0), []
    for number in range(4):
        world = jax.tree.map(lambda leaf, number=number: np.asarray(leaf[number]), env.worlds)
        model = mujoco_world.model(world)
        data = mujoco_world.settled(model)
        for start in world.starts[:4]:
            turn = tilted(rng.uniform(-3, 3), *rng.uniform(-0.08, 0.08, 2))
            origin = np.array([*start, 0.52])
            ours = np.asarray(look(world, jnp.asarray(origin, jnp.float32), jnp.asarray(turn)))
            level = np.stack([np.cos(mujoco_world.ANGLES), np.sin(mujoco_world.ANGLES), np.zeros(271)], -1)
            beams = level @ turn.T.astype(float)
            hit = np.zeros(1, np.int32)
            found = np.array([mujoco.mj_ray(model, data, origin, beam, None, 1, -1, hit) for beam in beams])
            down = np.where(beams[:, 2] < 0, -0.52 / np.minimum(beams[:, 2], -1e-9), np.inf)  # the floor
            equal.append(np.abs(ours - np.minimum(np.minimum(np.where(found < 0, np.inf, found), down), 10.0)) < 2e-3)
    assert np.mean(equal) > 0.997  # the rest: beams at an edge, and ones that come down onto a top


def test_in_c_mujoco_walking_toward_the_goal_reaches_it_or_meets_something():
    env = make_environment(NavigationConfig(worlds=8, max_steps=100))
    found = judged.rollout(Heuristic(env), env, jax.random.key(0), 6, 600)
    assert found["finished"].tolist() == [1.0] * 6
    np.testing.assert_allclose(sum(found[name] for name in ("success", "collision", "fall", "timeout")), np.ones(6))
    assert found["success"].any()
    assert 2.0 < found["duration"].mean() <= 20.0
