"""Instances in processes of their own: the same numbers, no orphans, pictures, a real arm."""

import base64
import dataclasses
import io
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium_worlds import Adder, limited
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
            after, step = jax.vmap(env.step)(
                jax.random.split(jax.random.fold_in(KEY, 99 - number), lanes), states, actions
            )
            return after, step.final_obs

        states, _ = jax.vmap(env.reset)(jax.random.split(KEY, lanes))
        return jax.lax.scan(one, states, jnp.arange(steps))[1]

    return np.asarray(rolled())


def test_processes_give_the_numbers_of_one_and_end_when_they_are_closed():
    here = cl.from_gymnasium(Adder, max_steps=6, processes=1).env
    there = cl.from_gymnasium(Adder, max_steps=6, processes=2).env
    np.testing.assert_array_equal(roll(here), roll(there))
    begun = pids(there)
    assert len(begun) == 2
    assert all(map(is_alive, begun))
    os.kill(begun[0], signal.SIGINT)  # an interrupt is for who waits
    roll(there)
    assert pids(there) == begun
    # A process that is killed is told, and its place is taken by a new one.
    os.kill(begun[1], signal.SIGKILL)
    world = cl.from_gymnasium(Adder, max_steps=6, processes=2)
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
    shown = [int(frame[0, 0, 0]) // 20 for frame in frames]
    assert shown == [*range(7), *range(4)]
    assert len(rewards) == 9
    pictures.question(env, states[2], None, jnp.float32([-0.5]), tmp_path / "question.png")
    assert Image.open(tmp_path / "question.png").size == (48, 16)
    (drawn,) = pids(env.replace(source=dataclasses.replace(env.source, draws=True)))
    pool.close_all()
    assert not is_alive(drawn)


def test_fetch_reach_is_what_plain_gymnasium_plays():
    world = cl.from_gymnasium("FetchReach-v4", num_envs=2, processes=2)
    assert world.config.max_steps == 50
    assert [cue.words for cue in world.actions.cues][1:3] == [("left", "right"), ("up", "down")]
    assert sum(quantity.size for quantity in world.observation) == 16
    assert {q.name for q in world.observation if q.unit == "m" and not q.kind} == {"desired goal"}
    env = world.env
    states, obs = jax.vmap(env.reset)(jax.random.split(KEY, 2))
    actions = np.random.default_rng(2).uniform(-1, 1, (6, 2, 4)).astype(np.float32)
    step = jax.jit(jax.vmap(env.step))
    found = []
    for number, action in enumerate(actions):
        states, went = step(jax.random.split(jax.random.fold_in(KEY, number), 2), states, action)
        found.append(jax.device_get(went))
    for lane in range(2):
        plain = source.make_registered("FetchReach-v4", {}, 0)
        first, _ = plain.reset(seed=int(states.seed[lane]))
        flat = lambda given: np.concatenate([given[name] for name in ("achieved_goal", "desired_goal", "observation")])  # noqa: E731
        np.testing.assert_array_equal(obs[lane], flat(first).astype(np.float32))
        for action, went in zip(actions, found, strict=True):
            given, reward, _, _, info = plain.step(action[lane])
            np.testing.assert_array_equal(went.final_obs[lane], flat(given).astype(np.float32))
            assert (went.reward[lane], went.outcome["success"][lane]) == (reward, info["is_success"])
        plain.close()
    # The slices are where their names say.
    ends = np.cumsum([quantity.size for quantity in world.observation])
    place = [quantity.name for quantity in world.observation].index("gripper position")
    given = plain.unwrapped._utils.get_site_xpos(plain.unwrapped.model, plain.unwrapped.data, "robot0:grip")
    np.testing.assert_array_equal(found[-1].final_obs[1, ends[place - 1] : ends[place]], given.astype(np.float32))


SCRIPT = """
    import os, time
    import gymnasium, jax, numpy as np
    import cuelearner_jax as cl
    from cuelearner_jax.bridges.gymnasium import pool

    class Slow(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Box(-1, 1, (2,))

        def reset(self, *, seed=None, options=None):
            return np.zeros(2, np.float32), {}

        def step(self, action):
            if abs(action[0] - 0.9) < 1e-6:
                time.sleep(100)
            return np.float32(action), 0.0, False, False, {}

    print("begun")
    world = cl.from_gymnasium(Slow, max_steps=5, processes=2)
    state, _ = world.reset(jax.random.key(0))
    (found,) = pool._pools.values()
    print(*[host.child.pid for host in found.hosts.values()], flush=True)
    world.step(jax.random.key(0), state, np.float32([0.9, 0]))
"""


@pytest.mark.long
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_a_script_needs_no_guard_and_leaves_no_process_behind(end, tmp_path):
    """The class lies in the script itself; the parent ends in the middle of a step that takes forever."""
    file = tmp_path / "script.py"
    file.write_text(textwrap.dedent(SCRIPT))
    with subprocess.Popen([sys.executable, file], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "begun\n"  # once: no process runs the script again
        begun = list(map(int, run.stdout.readline().split()))
        assert begun
        assert all(map(is_alive, begun))
        time.sleep(2)
        run.send_signal(end)
        if end == signal.SIGINT:
            time.sleep(1)
            run.kill()  # which waits inside a compiled program for a step without an end
    for _ in range(50):
        if not any(map(is_alive, begun)):
            break
        time.sleep(0.2)
    assert not any(map(is_alive, begun))


def test_a_factory_that_cannot_be_sent_is_told():
    lock = threading.Lock()  # no pickle holds it
    factory = lambda: limited() if lock else None  # noqa: E731
    world = cl.from_gymnasium(factory, processes=2)
    with pytest.raises(UserError, match="cannot be sent to another process"):
        cl.measure(lambda obs: obs[:, :1], world, episodes=2)
