"""The arm in Fetch: observations, rewards and success against Gymnasium's own, the camera, what cannot be there."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cuelearner_jax as cl
from cuelearner_envs.arm.config import ArmConfig
from cuelearner_jax.errors import UserError
from cuelearner_jax.tasks import arm

CAMERA = {"camera_turn_deg": 90.0, "camera_offset": (0.0, 0.02, 0.0)}
ACTIONS = np.array([[1.0, 0.5, 0.5, 1.0], [-1.0, 0.0, 0.25, 0.0], [0.1, -1.0, 1.0, -1.0]], np.float32)


def here(config):
    """The environment of a configuration, played in this process."""
    env: Any = arm.make_fetch(config)
    return env.replace(plays=env.plays.replace(source=dataclasses.replace(env.plays.source, processes=1)))


def fetchs_own(name, seed, actions):
    """What Gymnasium's environment gives for a seed and actions: flattened observations, rewards, success."""
    from gymnasium.spaces import flatten

    from cuelearner_jax.bridges.gymnasium.source import make_registered

    env = make_registered(name, {}, 50)
    rows, told = [env.reset(seed=seed)[0]], []
    for action in actions:
        obs, reward, _, _, info = env.step(action)
        rows.append(obs)
        told.append((reward, info["is_success"]))
    env.close()
    return np.float32([flatten(env.observation_space, row) for row in rows]), np.array(told)


def turned(place):
    """A place as the camera of these tests shows it, by hand: a quarter turn about (0.6918, 0.7441), then 2 cm left."""
    x, y, z = np.moveaxis(np.asarray(place), -1, 0)
    return np.stack([0.6918 - (y - 0.7441), 0.7441 + (x - 0.6918) + 0.02, z], -1)


@pytest.mark.parametrize("skill", ["reach", "push"])
def test_it_is_fetch_behind_the_camera(skill):
    pytest.importorskip("gymnasium_robotics")
    env = here(ArmConfig(skill, reward="sparse", max_steps=len(ACTIONS), **CAMERA))
    reset, step = jax.jit(lambda env, key: env.reset(key)), jax.jit(lambda env, *rest: env.step(*rest))
    state, obs = reset(env, jax.random.key(0))
    seen, told, first = [obs], [], int(state.episode.seed)
    for action in ACTIONS:
        state, taken = step(env, jax.random.key(1), state, jnp.asarray(action))
        seen.append(taken.final_obs)
        told.append((taken.reward, taken.outcome["success"]))
    true, wanted = fetchs_own({"reach": "FetchReach-v4", "push": "FetchPush-v4"}[skill], first, ACTIONS)
    seen = np.stack(seen)
    np.testing.assert_allclose(seen[:, 3:6], turned(true[:, 3:6]), atol=1e-6)
    if skill == "push":
        cube = turned(true[:, 9:12])
        np.testing.assert_allclose(seen[:, 0:3], cube, atol=1e-6)
        np.testing.assert_allclose(seen[:, 12:15], cube - true[:, 6:9], atol=1e-6)
        np.testing.assert_array_equal(seen[:, 15:], true[:, 15:])
    else:
        np.testing.assert_array_equal(seen[:, :3], true[:, :3])
        np.testing.assert_array_equal(seen[:, 6:], true[:, 6:])
    np.testing.assert_allclose(np.array(told, float), wanted)
    assert bool(taken.truncated)
    assert int(state.episode.seed) != first
    np.testing.assert_allclose(taken.obs, env.observe(state), atol=1e-6)


def test_fingers_that_go_down_do_not_press_on_the_table():
    pytest.importorskip("gymnasium_robotics")
    env = here(ArmConfig("pick", obstacle=False))
    reset, step = jax.jit(lambda env, key: env.reset(key)), jax.jit(lambda env, *rest: env.step(*rest))
    state, _ = reset(env, jax.random.key(0))
    for action in ([0.0, 0.0, -1.0, 1.0],) * 9 + ([0.0, 0.0, -1.0, -1.0],) * 3 + ([1.0, 0.0, -1.0, 0.0],) * 2:
        before = state.true
        state, _ = step(env, jax.random.key(1), state, jnp.array(action))
        if action[0]:
            assert state.true[6] - before[6] > 0.025  # as far as in the air; pressed down they move 1 cm
    assert state.true[8] < 0.425
    np.testing.assert_allclose(state.true[15:17], 0.0, atol=0.003)  # closed; pressed down they are 4.8 cm open each


def test_what_fetch_cannot_be_is_refused_in_one_line(monkeypatch):
    monkeypatch.setattr(arm, "find_spec", lambda name: object())
    with pytest.raises(UserError, match="Fetch's cube has a friction of its own: leave it out, or leave out --robot"):
        cl.make("arm", robot="fetch", scenario="slippery").env  # noqa: B018
    with pytest.raises(UserError, match="preferred_side is left, but no post stands in Fetch"):
        cl.make("arm", robot="fetch", scenario="past_left").env  # noqa: B018
    with pytest.raises(UserError, match="fetch is a robot of arm, not an engine: give --robot fetch"):
        arm.ARM.engine("fetch")
    monkeypatch.setattr(arm, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"is not installed: pip install 'cuelearner-jax\[gymnasium\]'"):
        cl.make("arm", robot="fetch").env  # noqa: B018
