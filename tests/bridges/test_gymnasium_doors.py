"""Environments as people have them: late or odd success, odd bounds, ids of one's own, wrappers that remember."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import cuelearner_jax as cl

BOX = spaces.Box(-1, 1, (1,), np.float32)


class World(gym.Env):
    """One step an episode by default; `action_space` and `info` are what a test is about."""

    observation_space = spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, actions=BOX, info=None, length=1):
        self.action_space, self.info, self.length, self.steps = actions, info or {}, length, 0

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        end = self.steps == self.length
        return np.zeros(1, np.float32), float(np.sum(action)), end, False, self.info if end else {}

    def close(self):
        raise AttributeError("no viewer")  # forgiven


def world(**about):
    return cl.from_gymnasium(lambda: World(**about), num_envs=1, processes=1, max_steps=200)


def measured(of, policy=lambda obs: 0 * obs):
    return {name: float(value[0]) for name, value in cl.measure(policy, of, episodes=1).metrics.items()}


@pytest.mark.parametrize(
    ("info", "length", "success"),
    [
        ({"is_success": True}, 150, 1),
        ({"succeed": True}, 1, 1),
        ({"success": np.array([True])}, 1, 1),
        ({"success": None}, 1, None),
    ],
)
def test_success_is_read_whenever_and_however_it_is_told(info, length, success):
    assert measured(world(info=info, length=length)).get("success") == success


def test_what_is_neither_success_nor_a_choice_is_refused():
    for value in (float("nan"), "yes"):
        with pytest.raises(cl.UserError, match="success"):
            world(info={"success": value})
    with pytest.raises(cl.UserError, match="chose -1: give the number of a choice, 0 to 2"):
        measured(world(actions=spaces.Discrete(3, start=-1)), lambda obs: np.full(len(obs), -1))


def test_choices_count_from_the_start_of_the_space_and_integers_are_rounded():
    assert measured(world(actions=spaces.Discrete(3, start=-1)), lambda obs: np.zeros(len(obs), int))["return"] == -1
    whole = world(actions=spaces.Box(0, 9, (1,), np.int64))
    assert measured(whole, lambda obs: 0 * obs + 2.7)["return"] == 3


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: World(spaces.Box(np.array([-1, 0]), np.array([1, 0]), dtype=np.float64)), "entry 2 .* only be 0"),
        (lambda: World(spaces.Box(-3.4e38, 3.4e38, (1,), np.float32)), "entry 1 .* no bounds"),
        (lambda: gym.make_vec("Pendulum-v1", num_envs=3), "a vector of 3"),
        (lambda: gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1")), "does not repeat itself"),
    ],
)
def test_what_is_no_environment_is_told_in_one_line(make, words):
    with pytest.raises(cl.UserError, match=words):
        cl.from_gymnasium(make, num_envs=1, processes=1)


def test_an_id_of_the_callers_own_is_played_in_other_processes():
    gym.register(id="doors/World-v0", entry_point=World, max_episode_steps=5)
    found = cl.measure(lambda obs: obs, cl.from_gymnasium("doors/World-v0", num_envs=2, processes=2), episodes=2)
    assert found.metrics["finished"][0] == 1
