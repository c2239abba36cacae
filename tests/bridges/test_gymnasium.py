"""Gymnasium's environments as pure functions of seed and actions."""

from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium_worlds import Adder, Faulty, Forgetful, Nested, start_of

import cuelearner_jax as cl
from cuelearner_jax.bridges.gymnasium import pool
from cuelearner_jax.bridges.gymnasium.pool import pool_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Choices

PAID = 13 / 64
KEYS = jax.random.split(jax.random.key(3), 40)


@pytest.fixture(autouse=True)
def closed():
    """Each test begins without instances, and leaves none."""
    pool.close_all()
    yield
    pool.close_all()


def world(env, max_steps=6, **settings):
    return cl.from_gymnasium(env, processes=1, **({} if isinstance(env, str) else {"max_steps": max_steps}), **settings)


def same(found, wanted):
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(found), jax.device_get(wanted))


def walk(world, actions, state=None):
    """States and steps, the first state the reset's."""
    state, states, steps = world.reset(KEYS[0])[0] if state is None else state, [], []
    for key, action in zip(KEYS[1:], actions, strict=False):
        states.append(state)
        state, step = world.step(key, state, np.float32(action))
        steps.append(jax.device_get(step))
    return [*states, state], steps


def instances_of(world):
    """The instances of this process."""
    return pool_of(world.env.source).hosts[0].instances


def rows(steps, name):
    return np.stack([getattr(step, name) for step in steps])


# --- what a step is --------------------------------------------------------------------------------------------------


def test_a_step_is_that_of_the_environment():
    here = world(Adder)
    state, obs = here.reset(KEYS[0])
    start = start_of(state.seed)
    np.testing.assert_array_equal(obs, np.float32([start, 0]))
    states, steps = walk(here, [[PAID]] * 6 + [[1.0]] * 3, state)
    # The sixth step passes 1.5, with the start that this key draws, as time runs out.
    totals = start + PAID * np.arange(1, 7)
    assert totals[-2] <= 1.5 < totals[-1]
    np.testing.assert_array_equal(rows(steps[:6], "final_obs"), np.float32([totals, np.arange(1, 7)]).T)
    np.testing.assert_array_equal(rows(steps[:6], "reward"), np.float32(PAID).repeat(6))
    assert rows(steps[:6], "terminated").tolist() == [False] * 5 + [True]
    assert not rows(steps[:6], "truncated").any()  # the end is a termination, even where time runs out with it
    assert (steps[5].outcome["success"], steps[5].outcome["return"]) == (1.0, 6 * PAID)
    # The next episode begins with a seed of the step's key, and its first observation is the one to act on.
    again = start_of(states[6].seed)
    assert states[6].seed != state.seed
    assert states[6].steps == 0
    np.testing.assert_array_equal(steps[5].obs, np.float32([again, 0]))
    np.testing.assert_array_equal(steps[6].final_obs, np.float32([again + 1.0, 1]))
    np.testing.assert_array_equal(steps[0].obs, steps[0].final_obs)
    np.testing.assert_array_equal(steps[0].aftermath, steps[0].final_obs)


def test_time_that_runs_out_is_a_truncation_by_the_environment_or_by_the_caller():
    for limit, last in ((100, 5), (3, 2)):
        _, steps = walk(world(Adder, max_steps=limit), [[-0.5]] * 6)
        assert np.flatnonzero(rows(steps, "truncated"))[0] == last
        assert not rows(steps, "terminated").any()
        assert steps[last].outcome["success"] == 0.0
        assert steps[last].final_obs[1] == last + 1
        assert steps[last].obs[1] == 0


# --- states are kept, shown again, resumed ---------------------------------------------------------------------------


def test_a_state_that_was_left_is_taken_up_by_replaying_its_actions():
    here = world(Adder)
    actions = [[0.1], [0.2], [-0.3], [0.05]]
    states, steps = walk(here, actions)
    found = instances_of(here)
    assert found.replays == 0
    for number in (1, 3, 0, 2):
        after, step = here.step(KEYS[number + 1], states[number], np.float32(actions[number]))
        same((after, step), (states[number + 1], steps[number]))
    assert found.replays == 1 + 3  # the instance that was put to state 1 then stands at state 2
    branched, _ = walk(here, [[0.4]], states[2])
    assert branched[1].place.tolist() != states[3].place.tolist()
    # Other worlds end this one's instances; the next is one that replays.
    for start in np.arange(pool.MOST_POOLS):
        world(Adder, start=start + 1).reset(KEYS[0])
    assert len(pool._pools) == pool.MOST_POOLS
    same(here.step(KEYS[4], states[3], np.float32(actions[3])), (states[4], steps[3]))
    assert instances_of(here).replays == 3


def test_lanes_that_share_a_state_each_get_an_instance():
    here = world(Adder)
    env, (state, _) = here.env, here.reset(KEYS[0])
    lanes = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), state)

    @jax.jit
    def three(lanes):
        def one(lanes, number):
            actions = jnp.array([[0.1], [0.1], [0.2], [-0.3]]) * (number + 1)
            return jax.vmap(env.step)(jnp.stack([KEYS[9]] * 4), lanes, actions)

        return jax.lax.scan(one, lanes, jnp.arange(3))[1]

    totals = three(lanes).final_obs[-1, :, 0]
    np.testing.assert_allclose(totals, start_of(state.seed) + np.array([0.6, 0.6, 1.2, -1.8]), rtol=1e-6)
    found = instances_of(here)
    assert len(found.running) == 4
    assert found.replays == 0
    # Two sets of lanes, one after the other: instances of both are kept, and replayed once.
    for _ in range(3):
        three(lanes)
    assert len(found.running) <= 8


class Counted(Adder):
    played = 0

    def step(self, action):
        Counted.played += 1
        return super().step(action)


def test_an_evaluation_plays_one_episode_in_each_environment():
    here = world(Counted, max_steps=20)
    Counted.played = 0
    metrics = cl.measure(lambda obs: np.full((len(obs), 1), PAID), here, episodes=8).metrics
    assert metrics["reward"][0] == PAID  # a step of these episodes
    assert Counted.played == metrics["return"][0] * 8 / PAID  # a return is that of so many steps


def test_an_environment_that_does_not_repeat_itself_is_told():
    here = world(Forgetful)
    states, _ = walk(here, [[0.1]] * 3)
    with pytest.raises(UserError, match=r"Forgetful does not repeat itself: with seed \d+ and the same 1 actions"):
        here.step(KEYS[0], states[1], np.float32([0.1]))


# --- spaces ----------------------------------------------------------------------------------------------------------


def test_nested_observations_are_named_and_flattened_in_the_order_of_their_space():
    here = world(Nested)
    assert [(quantity.name, quantity.size) for quantity in here.observation] == [
        ("arm", 4),
        ("lights", 2),
        ("modes", 5),
        ("wheels.0", 2),
        ("wheels.1", 3),
    ]
    assert here.actions == Choices(3)
    state, obs = here.reset(KEYS[0])
    arm, lights, modes, wheels = [0.1, 0.2, 0.3, 0.4], [1, 0], [0, 1, 0, 0, 1], [0.5, -0.5]
    np.testing.assert_array_equal(obs, np.float32([*arm, *lights, *modes, *wheels, 1, 0, 0]))
    np.testing.assert_array_equal(obs, spaces.flatten(Nested.observation_space, Nested().reset()[0]).astype(np.float32))
    _, steps = walk(here, np.eye(3), state)
    assert rows(steps, "reward").tolist() == [5, 6, 7]
    np.testing.assert_array_equal(rows(steps, "final_obs")[:, -3:], np.eye(3))


def test_files_keep_the_arguments_of_a_partial():
    assert world(partial(Adder, start=2.0)).env.source.arguments == '{"start": 2.0}'


def test_beams_have_the_angle_between_them():
    (lidar,) = world(Adder, observation=[("lidar", 2, "m", "", "beams", 7.5)]).observation
    assert (lidar.kind, lidar.step_deg) == ("beams", 7.5)


BOX = spaces.Box(-1, 1, (1,), np.float32)
# `Nested` as its dictionary is written, not as it is flattened
AS_WRITTEN = [("wheels.0", 2, "1"), ("wheels.1", 3, "1"), ("arm", 4, "1"), ("lights", 2, "1"), ("modes", 5, "1")]


# --- wrong calls and wrong environments ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"env": "CartPol-v1"}, "no environment 'CartPol-v1', did you mean 'CartPole-v1'.*; of an id that your own"),
        ({"env": "os:system"}, "would import code"),
        ({"env": Adder, "max_steps": 0}, "max_steps is 0: give a number from 1"),
        ({"env": Adder, "cues": "left,right;up,down"}, "2 cues for 1 entries"),
        ({"env": Adder, "start": (0, 0)}, r"arguments are {'start': \(0, 0\)}, which JSON does not keep"),
        ({"env": Adder, "observation": [("total", 2, "m", "", "", 0.0, (0.0, 0.0))]}, "observation has an origin"),
        ({"env": Adder, "observation": [("total", 2, "m", "", "beams x")]}, "slice_kinds is .*beams x.*: give a size"),
        ({"env": Adder, "observation": [("total", 3, "m")]}, "names 3 entries, and .*Adder has 2"),
        ({"env": Nested, "observation": AS_WRITTEN}, "another order or size than .*Nested's vector"),
        ({"env": Adder, "units": {"observation": "metres"}}, "unit of 'observation' is 'metres': give a symbol, as m"),
    ],
)
def test_wrong_calls_are_told_in_one_line(settings, told):
    with pytest.raises(UserError, match=told) as refused:
        cl.from_gymnasium(**settings)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("raises", "raised RuntimeError: a joint is jammed: mend it first"),
        ("shape", r"outside its space in step 3 .* 'observation' is an array of shape \(3,\)"),
    ],
)
def test_faults_of_an_environment_are_told_with_their_step(fault, told):
    here = world(Faulty, fault=fault)
    with pytest.raises(UserError, match=told) as refused:
        cl.measure(lambda obs: obs[:, :1], here, episodes=3)
    assert "Faulty" in str(refused.value)
    assert "step 3" in str(refused.value)
    # What went well before goes on, and what begins anew does too.
    state, _ = here.reset(KEYS[0])
    after, _ = here.step(KEYS[1], state, np.float32([0.1]))
    assert after.steps == 1


# --- environments as people have them: late or odd success, odd bounds, ids of their own -----------------------------


class World(gymnasium.Env):
    """One step an episode by default; `action_space` and `info` are what a test is about."""

    observation_space = spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, actions=BOX, info=None, length=1):
        self.action_space, self.info, self.length, self.steps = actions, info or {}, length, 0

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        end = self.steps == self.length
        return np.zeros(1, np.float32), float(np.sum(action)), end, False, self.info if end else None

    def close(self):
        raise AttributeError("no viewer")  # forgiven


def short(**about):
    return world(lambda: World(**about), max_steps=200, num_envs=1)


def measured(of, policy=lambda obs: 0 * obs):
    return {name: float(value[0]) for name, value in cl.measure(policy, of, episodes=1).metrics.items()}


@pytest.mark.parametrize(("info", "length", "success"), [({"is_success": True}, 150, 1), ({"success": None}, 1, None)])
def test_success_is_read_whenever_and_however_it_is_told(info, length, success):
    assert measured(short(info=info, length=length)).get("success") == success


def test_what_is_neither_success_nor_a_choice_is_refused():
    for value in (float("nan"), "yes"):
        with pytest.raises(UserError, match="success"):
            short(info={"success": value})
    with pytest.raises(UserError, match="chose -1: give the number of a choice, 0 to 2"):
        measured(short(actions=spaces.Discrete(3, start=-1)), lambda obs: np.full(len(obs), -1))


def test_choices_count_from_the_start_of_the_space_and_integers_are_rounded():
    assert measured(short(actions=spaces.Discrete(3, start=-1)), lambda obs: np.zeros(len(obs), int))["return"] == -1
    assert measured(short(actions=spaces.Box(0, 9, (1,), np.int64)), lambda obs: 0 * obs + 2.7)["return"] == 3
    tenth = short(actions=spaces.Box(-0.1, 0.1, (1,), np.float64))  # in single precision 0.1 is more
    assert measured(tenth, lambda obs: 0 * obs + 1)["return"] == np.float32(0.1)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: World(spaces.Box(np.array([-1, 0]), np.array([1, 0]), dtype=np.float64)), "each high above its low"),
        (lambda: World(spaces.Box(-3.4e38, 3.4e38, (1,), np.float32)), "entry 1 .* no bounds"),
        (lambda: gymnasium.make_vec("Pendulum-v1", num_envs=3), "a vector of 3"),
        (type("Old", (World,), {"reset": lambda self, **_: np.zeros(1)}), r"return \(observation, info\), which is"),
        (type("Old", (World,), {"step": lambda *_: (np.zeros(1), 0.0, True, {})}), r"return \(observation, reward, te"),
        (lambda: gymnasium.wrappers.NormalizeObservation(gymnasium.make("Pendulum-v1")), "does not repeat itself"),
    ],
)
def test_what_is_no_environment_is_told_in_one_line(make, words):
    with pytest.raises(UserError, match=words):
        cl.from_gymnasium(make, num_envs=1, processes=1)


def test_an_instance_cannot_be_given_in_place_of_a_class():
    one = Adder()
    world = cl.from_gymnasium(lambda: one, processes=1)
    with pytest.raises(UserError, match="the same instance each time: let the function make a new environment"):
        cl.measure(lambda obs: 0 * obs[:, :1], world, episodes=2)


def test_episodes_that_all_begin_alike_are_told_once(capsys):
    cl.from_gymnasium(World, num_envs=1, processes=1)
    lines = capsys.readouterr().err
    assert lines.count("all episodes begin alike, whatever their seed") == lines.count("World names no limit") == 1
    cl.from_gymnasium("Pendulum-v1", num_envs=1, processes=1)
    cl.from_gymnasium(Adder, num_envs=1, processes=1)  # which truncates its episodes itself
    assert capsys.readouterr().err == ""


def test_an_id_is_played_in_other_processes_as_its_caller_registered_it_last(monkeypatch):
    for name, start in (("doors/Adder-v0", 2), ("Pendulum-v1", 0), ("Pendulum-v1", 2)):  # from 2 it succeeds at once
        spec = EnvSpec(name, entry_point=Adder, max_episode_steps=5, kwargs={"start": start})
        monkeypatch.setitem(gymnasium.registry, name, spec)
        there = cl.from_gymnasium(name, num_envs=2, processes=2)
        assert cl.measure(lambda obs: 0 * obs[:, :1], there, episodes=2).metrics["success"][0] == (start == 2)
