"""Instances in processes of their own: the same numbers, no orphans, pictures, a real arm."""

import base64
import dataclasses
import io
import os
import re
import signal
import threading
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium_worlds import Adder, Forgetful, limited
from PIL import Image

import cuelearner_jax as cl
from cuelearner_jax.bridges.gymnasium import pool, source
from cuelearner_jax.bridges.gymnasium.pool import Process, pool_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import uniform_in

KEY = jax.random.key(5)


@pytest.fixture(autouse=True)
def closed():
    yield
    pool.close_all()


def is_alive(number):
    """Whether a process runs; one that ended and is not waited for does not."""
    try:
        with open(f"/proc/{number}/stat") as file:
            return file.read().split()[2] != "Z"
    except FileNotFoundError:
        return False


def pids(env):
    return [host.child.pid for host in pool_of(env.source).hosts.values() if isinstance(host, Process)]


def shade(sketch):
    """The number that a picture's pixels have."""
    data = base64.b64decode(re.search('base64,([^"]*)', sketch.still)[1])
    return round(float(np.asarray(Image.open(io.BytesIO(data)).convert("L")).mean()))


def roll(env, lanes=5, steps=8):
    """Final observations (steps, lanes, obs) of random actions, in one program."""

    @jax.jit
    def rolled():
        def one(states, number):
            actions = env.actions.sample(jax.random.fold_in(KEY, number), (lanes,))
            keys = jax.random.split(jax.random.fold_in(KEY, 99 - number), lanes)
            after, step = jax.vmap(env.step)(keys, states, actions)
            return after, step.final_obs

        states, _ = jax.vmap(env.reset)(jax.random.split(KEY, lanes))
        return jax.lax.scan(one, states, jnp.arange(steps))[1]

    return np.asarray(rolled())


def test_processes_give_the_numbers_of_one_and_end_when_they_are_closed(monkeypatch):
    here = cl.from_gymnasium(Adder, max_steps=6, processes=1).env
    there = (world := cl.from_gymnasium(Adder, max_steps=6, processes=2)).env
    with monkeypatch.context() as patched:  # no answer stays unread
        patched.setattr(Process, "receive", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            world.reset(KEY)
    np.testing.assert_array_equal(roll(here), roll(there))
    begun = pids(there)
    assert len(begun) == 2
    assert all(map(is_alive, begun))
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # each is for who waits
        os.kill(begun[0], number)
    roll(there)
    assert pids(there) == begun
    # A process that is killed is told, and its place is taken by a new one.
    os.kill(begun[1], signal.SIGKILL)
    with pytest.raises(UserError, match=r"a process that played it ended \(exit status -9\): see what it wrote"):
        cl.measure(lambda obs: obs[:, :1], world, episodes=5)
    assert np.isfinite(cl.measure(lambda obs: obs[:, :1], world, episodes=5).metrics["return"]).all()
    begun += pids(there)
    pool.close_all()
    assert not any(map(is_alive, begun))


def test_pictures_are_of_the_state_that_is_shown(tmp_path):
    world = cl.make("gymnasium:gymnasium_worlds:limited", processes=1)
    env, pictures = world.env, world.task.pictures()
    state, _ = world.reset(KEY)
    states = [state]
    for number in range(3):
        state, _ = world.step(jax.random.fold_in(KEY, number), state, np.float32([0.1]))
        states.append(state)
    for number in (0, 2, 3, 1):  # `Adder` draws 20 a step
        assert shade(pictures.sketch(env, states[number])) == 20 * number
    assert pictures.sketch(env, states[2]).box == (0.0, 0.0, 24, 16)
    clip = pictures.reel(env, states[2], jnp.float32([-0.5]))
    assert (len(clip.pictures), clip.words) == (5, "held for 4 steps")  # the episode ends by time after six
    frames, rewards = pictures.record(env, uniform_in(env), KEY, 9)
    assert [int(frame[0, 0, 0]) // 20 for frame in frames] == [*range(7), *range(4)]
    assert len(rewards) == 9
    pictures.question(env, states[2], None, jnp.float32([-0.5]), tmp_path / "question.png")
    assert Image.open(tmp_path / "question.png").size == (48, 16)
    forgetful = cl.from_gymnasium(Forgetful, max_steps=6, processes=1)
    with pytest.raises(UserError, match="elsewhere than before, so pictures would show other situations: let it draw"):
        pictures.sketch(forgetful.env, forgetful.step(KEY, forgetful.reset(KEY)[0], np.float32([0.1]))[0])
    with pytest.raises(UserError, match="so pictures would show other situations"):
        pictures.record(forgetful.env, uniform_in(env), KEY, 4)
    (drawn,) = pids(env.replace(source=dataclasses.replace(env.source, draws=True)))
    pool.close_all()
    assert not is_alive(drawn)


def test_slices_of_fetch_reach_are_where_their_names_say():
    """What it plays is plain Gymnasium's: tests/envs/arm/test_fetch.py."""
    world = cl.from_gymnasium("FetchReach-v4", num_envs=2, processes=2)
    assert world.config.max_steps == 50
    assert [cue.words for cue in world.actions.cues][1:3] == [("left", "right"), ("up", "down")]
    assert sum(quantity.size for quantity in world.observation) == 16
    assert {q.name for q in world.observation if q.unit == "m" and not q.kind} == {"desired goal"}
    state, obs = world.reset(KEY)
    plain = source.make_registered("FetchReach-v4", {}, 0)
    plain.reset(seed=int(state.seed))
    ends = np.cumsum([quantity.size for quantity in world.observation])
    place = [quantity.name for quantity in world.observation].index("gripper position")
    given = plain.unwrapped._utils.get_site_xpos(plain.unwrapped.model, plain.unwrapped.data, "robot0:grip")
    np.testing.assert_array_equal(obs[ends[place - 1] : ends[place]], given.astype(np.float32))


def test_a_factory_that_cannot_be_sent_is_told():
    lock = threading.Lock()  # no pickle holds it
    factory = lambda: limited() if lock else None  # noqa: E731
    world = cl.from_gymnasium(factory, processes=2)
    with pytest.raises(UserError, match="cannot be sent to another process"):
        cl.measure(lambda obs: obs[:, :1], world, episodes=2)
