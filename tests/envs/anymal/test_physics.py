"""Walking in MJX: steps of control against C MuJoCo, rewards and ends by hand. One compile serves the whole file."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cuelearner_envs.anymal import model as robot
from cuelearner_envs.anymal.locomotion import Locomotion, Trial
from cuelearner_envs.anymal.physics import AnymalGround
from cuelearner_envs.anymal.policy import OBS

pytestmark = pytest.mark.long

ROBOTS = 8
SCENES = ("standing", "trotting", "flying", "slippery", "loaded", "on its side", "low", "blown up")
CALM = Trial(rest=1.0)  # no noise, no pushes; commands to stand


@pytest.fixture(scope="module")
def env():
    return Locomotion(CALM)


@pytest.fixture(scope="module")
def scenes(env):
    """Eight robots in different configurations, on different grounds, and actions for them."""
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), ROBOTS))
    rng = np.random.default_rng(0)
    qpos, qvel = np.array(state.pipeline_state.body.qpos), np.array(state.pipeline_state.body.qvel)
    qpos[:, :7], qvel[:] = [0, 0, 0.54, 1, 0, 0, 0], 0
    qpos[1, 7:] += rng.uniform(-0.3, 0.3, 12)
    qvel[1] = rng.uniform(-0.5, 0.5, 18)
    qpos[2, 2], qvel[2, :6] = 1.0, [1.0, -0.5, 0.3, 0.4, -0.6, 0.8]
    qvel[3, :2] = 0.8, 0.4  # slides
    qpos[5, :7] = [0, 0, 0.6, np.cos(0.7), np.sin(0.7), 0, 0]
    qpos[6, 2] = 0.25
    qvel[7, 0] = np.nan
    friction = jnp.array([0.8, 0.8, 0.8, 0.3, 0.8, 0.8, 0.8, 0.8])
    ground = AnymalGround(friction=friction, payload=jnp.array([0, 0, 0, 0, 6.0, 0, 0, 0]))
    walk = state.pipeline_state
    body = walk.body.replace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel))
    state = state.replace(pipeline_state=walk.replace(body=body, ground=ground))
    return state, jnp.asarray(rng.uniform(-0.5, 0.5, (ROBOTS, 12)), jnp.float32)


@pytest.fixture(scope="module")
def stepped(env, scenes):
    """The scenes a step of control later."""
    return jax.jit(jax.vmap(env.step))(*scenes)


def in_c(state, action, number):
    """The same step of control in C MuJoCo, with the solver's settings of the file."""
    walk = state.pipeline_state
    model = robot.load(friction=float(walk.ground.friction[number]), payload=float(walk.ground.payload[number]))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = walk.body.qpos[number], walk.body.qvel[number]
    data.ctrl[:] = robot.HOME + robot.ACTION_SCALE * np.asarray(action[number])
    mujoco.mj_step(model, data, nstep=2)
    return data


@pytest.mark.parametrize("number", range(7), ids=SCENES[:7])
def test_a_step_of_control_is_that_of_c_mujoco(scenes, stepped, number):
    data, body = in_c(*scenes, number), stepped.pipeline_state.body
    np.testing.assert_allclose(body.qpos[number], data.qpos, atol=5e-4)
    np.testing.assert_allclose(body.qvel[number], data.qvel, atol=0.03)


def test_falls_end_the_episode(stepped):
    done = dict(zip(SCENES, np.asarray(stepped.done), strict=True))
    assert {name for name, value in done.items() if value} == {"on its side", "low", "blown up"}


def test_observations_are_what_the_policy_is_told_in_order(stepped):
    walk = stepped.pipeline_state
    obs = np.asarray(stepped.obs)[0]
    assert obs.shape == (OBS,)
    np.testing.assert_allclose(obs[6:9], [0, 0, -1], atol=0.05)  # down
    np.testing.assert_allclose(obs[9:12], walk.command[0])
    np.testing.assert_allclose(obs[12:24], walk.body.qpos[0, 7:] - robot.HOME, atol=1e-6)
    np.testing.assert_allclose(obs[24:36], walk.body.qvel[0, 6:], atol=1e-6)
    np.testing.assert_allclose(obs[36:], walk.last_action[0])
