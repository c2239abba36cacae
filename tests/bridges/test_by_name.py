"""brax's environments and MuJoCo Playground's tasks, by name."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from brax import envs

import cuelearner_jax as cl
from cuelearner_jax.cli import main
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Box
from cuelearner_jax.task import shape_of
from cuelearner_jax.tasks import registry, simulators
from cuelearner_jax.testing import check_environment, check_task

FAST = registry.resolve("brax:fast")


def same_steps(world, simulator, steps, tolerance=0.0):
    """Hold our roll-out of random actions against the simulator's own: the same key, the same actions, no end."""
    key = jax.random.key(3)
    actions = world.actions.sample(jax.random.key(4), (steps,))
    reset, advance = jax.jit(simulator.reset), jax.jit(simulator.step)
    state, obs = world.reset(key)
    other = reset(jax.random.key_data(key))
    np.testing.assert_allclose(obs, other.obs, atol=tolerance)
    for number, action in enumerate(actions):
        state, step = world.step(jax.random.key(number), state, action)
        other = advance(other, action)
        assert not step.terminated
        np.testing.assert_allclose(step.final_obs, other.obs, rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(step.reward, other.reward, rtol=tolerance, atol=tolerance)
        for name, value in other.metrics.items():
            np.testing.assert_allclose(step.metrics[name], value, rtol=tolerance, atol=tolerance)


def test_a_name_gives_the_whole_box_and_the_layout():
    pusher = registry.resolve("brax:pusher")
    assert (pusher.name, pusher.about) == ("brax", "brax's pusher")
    env = shape_of(pusher, pusher.plain())
    assert spaces_of(env).obs_size == 23
    assert isinstance(env.actions, Box)
    assert (env.actions.low, env.actions.high) == ((-1.0,) * 7, (1.0,) * 7)
    assert env.actions.cues[0].name == "r_shoulder_pan_joint"
    assert registry.resolve("brax:pusher") == pusher
    assert pusher.plain().max_steps == 1000
    assert registry.find("brax").presets == {}  # the family's own task reads folders, and is no environment


def test_a_step_is_that_of_brax():
    same_steps(cl.make("brax:fast"), envs.get_environment("fast"), 5)


def test_a_task_of_a_family_keeps_the_laws():
    check_task(FAST, dataclasses.replace(FAST.plain(), max_steps=3), steps=8)


def test_what_policies_look_at_needs_no_simulator(monkeypatch):
    def nothing(*_):
        raise AssertionError("the simulator was made")

    monkeypatch.setattr(simulators, "_simulator", nothing)
    env = registry.find("brax").view(FAST.plain())
    assert (env.obs_size, env.actions.size) == (2, 1)
    config = simulators.PlaygroundConfig("Any", slices=("a", "b"), slice_sizes=(2, 3), entries=("x",))
    assert shape_of(registry.find("playground"), config).obs_size == 5


def test_a_name_that_is_none_is_refused_in_one_line(capsys):
    assert main(["train", "brax", "--out", "nowhere"]) == 2
    assert "brax is a family of tasks: name one of its environments, as brax:NAME" in capsys.readouterr().err
    assert main(["train", "brax:pushr", "--out", "nowhere"]) == 2
    assert "brax has no environment 'pushr', did you mean 'pusher'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"max_steps": 0}, "task.max_steps is 0: give a number from 1 to 1,000,000"),
        ({"slice_sizes": (1, 1)}, "name the task brax:ENVIRONMENT, which fills them"),
    ],
)
def test_a_configuration_that_makes_no_environment_is_refused_in_one_line(changes, says):
    with pytest.raises(UserError, match=re.escape(says)):
        FAST.environment(dataclasses.replace(FAST.plain(), **changes))


def test_a_simulator_of_another_layout_is_refused():
    world = cl.make("brax:fast", environment="inverted_pendulum")
    says = "brax:inverted_pendulum has other observations or actions than its configuration"
    with pytest.raises(UserError, match=says):
        world.reset(jax.random.key(0))


# Real physics, which takes tens of seconds to compile.


@pytest.mark.long
def test_cartpole_is_that_of_playground_step_for_step():
    suite = pytest.importorskip("mujoco_playground").dm_control_suite
    world = cl.make("playground:CartpoleBalance", max_steps=4, overrides=("ctrl_dt=0.02",))
    assert [cue.name for cue in world.actions.cues] == ["slide"]
    simulator = suite.load("CartpoleBalance", config_overrides={"impl": "jax", "ctrl_dt": 0.02})
    same_steps(dataclasses.replace(world, config=dataclasses.replace(world.config, max_steps=1000)), simulator, 5, 1e-4)
    for wrong in ("ctrl_dt=fast", "ctrl=0.02", "ctrl_dt"):
        with pytest.raises(UserError, match=re.escape(f"--task.overrides has {wrong!r}")):
            cl.make("playground:CartpoleBalance", overrides=(wrong,)).reset(jax.random.key(0))
    check_environment(world.env, 8, tolerance=1e-4)
