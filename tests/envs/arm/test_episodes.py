"""Whole episodes of the arm with a cube, in MJX and in C MuJoCo. One compiled program serves the whole file."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.arm import model as arm
from cuelearner_envs.arm import physics
from cuelearner_envs.arm.environment import Arm
from cuelearner_envs.arm.judged import MujocoArm, rollout
from cuelearner_envs.arm.physics import ArmGround
from cuelearner_envs.arm.scripts import past, pick

EPISODES, STEPS = 24, 50
F = jnp.float32


def script(env, side, obs):
    """The scripts of both skills in one program."""
    friction = env.ground.friction
    return jnp.where(env.grasps > 0, pick(obs, friction), past(obs, side, friction, env.ground.post))


@partial(jax.jit, static_argnames="episodes")
def walked(env, side, key, episodes=EPISODES):
    """Final outcomes, and each state with the targets that were told there."""

    def one(carry, number):
        states, obs = carry
        keys = jax.random.split(jax.random.fold_in(key, number), episodes)
        actions = script(env, side, obs)
        targets = jax.vmap(lambda state, action: env.command(state, action).all(True))(states, actions)
        following, step = jax.vmap(env.step)(keys, states, actions)
        return (following, step.obs), (states, obs, targets, step)

    begun = jax.vmap(env.reset)(jax.random.split(key, episodes))
    states, obs, targets, steps = jax.lax.scan(one, begun, jnp.arange(STEPS))[1]
    return jax.tree.map(lambda leaf: leaf[-1], steps.outcome), states, obs, targets, steps


class Scripted:
    """The script of `pick` as a policy."""

    def act(self, key, states, obs):
        return pick(obs)


def world(post=1.0, grasps=0.0, friction=1.0):
    """Both skills as values of one environment's fields."""
    return Arm(
        ground=ArmGround(friction=F(friction), post=F(post)),
        grasps=F(grasps),
        within=F(0.05),
        max_steps=jnp.int32(STEPS),
        skill="push",
    )


def run(side=0.0, seed=0, episodes=EPISODES, **changes):
    return jax.device_get(walked(world(**changes), F(side), jax.random.key(seed), episodes))


@pytest.fixture(scope="module")
def pushed():
    return run()


@pytest.fixture(scope="module")
def picked():
    return run(post=0.0, grasps=1.0)


def test_scripts_succeed(pushed, picked):
    assert pushed[0]["success"].mean() >= 0.95
    assert picked[0]["success"].mean() >= 0.95


def test_cubes_pass_the_post_on_both_sides_or_on_the_preferred_one(pushed):
    assert pushed[0]["passed_left"].sum() > 3
    assert pushed[0]["passed_right"].sum() > 3
    assert run(side=-1.0)[0]["passed_right"].mean() >= 0.9


def test_nothing_goes_through_anything(pushed, picked):
    for _, states, *_ in (pushed, picked):
        cubes = states.body.qpos[..., physics.CUBE]
        assert cubes[..., 2].min() > arm.RESTING - 0.006  # of the cube, on the table
        fingers = states.body.qpos[..., physics.FINGERS]
        assert fingers.min() > -0.008  # a cube may press a finger, whose drive gives way
        assert fingers.max() < arm.OPEN + 0.008
    post = np.linalg.norm(pushed[1].body.qpos[..., physics.CUBE][..., :2] - np.array(arm.POST_PLACE), axis=-1)
    assert post.min() > arm.CUBE + arm.POST_RADIUS - 0.004
    low = pushed[1].body.qpos[..., 2] < arm.TABLE + arm.POST_HEIGHT + arm.TIP - 0.01
    gripper = np.linalg.norm(pushed[1].body.qpos[..., :2] - np.array(arm.POST_PLACE), axis=-1)
    assert gripper[low].min() > arm.POST_RADIUS + arm.FINGER_RADIUS


def test_observations_are_laid_out_as_fetchs(picked):
    _, states, obs, _, _ = picked
    body, gripper = states.body, states.body.qpos[..., physics.GRIPPER]
    cube = body.qpos[..., physics.CUBE][..., :3]
    for first, wanted in (
        (0, cube),
        (3, states.goal),
        (6, gripper),
        (9, cube),
        (12, cube - gripper),
        (15, body.qpos[..., physics.FINGERS]),
        (20, (body.qvel[..., physics.CUBE_VELOCITY] - body.qvel[..., physics.GRIPPER]) * 0.04),
        (26, body.qvel[..., physics.GRIPPER] * 0.04),
        (29, body.qvel[..., physics.FINGERS] * 0.04),
    ):
        assert np.allclose(obs[..., first : first + wanted.shape[-1]], wanted, atol=1e-6)
    assert obs.shape[-1] == 31


def test_reward_is_minus_the_ways_from_gripper_to_cube_to_goal(pushed):
    _, states, _, _, steps = pushed
    after = jax.tree.map(lambda leaf: leaf[1:], states)  # no episode ends before the last step
    cube = after.body.qpos[..., physics.CUBE][..., :3]
    ways = np.linalg.norm(cube - after.goal, axis=-1)
    ways += 0.5 * np.linalg.norm(cube - after.body.qpos[..., physics.GRIPPER], axis=-1)
    assert np.allclose(steps.reward[:-1], -ways, atol=1e-5)
    assert steps.truncated[-1].all()
    assert not steps.truncated[:-1].any()
    assert not steps.terminated.any()


@pytest.mark.parametrize("which", ["pushed", "picked"])
def test_c_mujoco_agrees_step_by_step(which, request):
    """Each step of control begins where MJX stood."""
    _, states, _, targets, _ = request.getfixturevalue(which)
    judge = MujocoArm(world(post=float(which == "pushed")), EPISODES, arm.CONTROL_PERIOD / arm.SUBSTEPS, None)
    off = []
    for step in range(0, STEPS - 1, 6):
        now, following = (jax.tree.map(lambda leaf, n=n: leaf[n], states.body) for n in (step, step + 1))
        judge.place(now)
        off.append(np.abs(np.asarray(judge.control(targets[step]).qpos) - following.qpos)[:, :8].max(-1))
    middle, most = np.quantile(np.array(off), [0.5, 0.9])  # [m]; in hard contacts the few iterations of MJX tell
    assert middle < 1e-5
    assert most < 3e-3


def test_c_mujoco_judges_the_scripts_alike():
    """Finer steps, solved to convergence; the gripper's own engine is named by `--engine mujoco`."""
    found = rollout(Scripted(), world(post=0.0, grasps=1.0), jax.random.key(0), EPISODES, EPISODES * STEPS)
    assert found["finished"].all()
    assert found["success"].mean() >= 0.95
    assert found["distance"].shape == (EPISODES,)
