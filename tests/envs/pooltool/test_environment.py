"""Our table in pooltool. What needs pooltool itself is skipped where it is not installed: its compile takes minutes."""

from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cuelearner_jax as cl
from cuelearner_envs.billiards.config import BilliardsConfig
from cuelearner_envs.billiards.config import make_environment as make_billiards
from cuelearner_envs.billiards.environment import Balls
from cuelearner_envs.billiards.foreign import ForeignBilliards, play_many
from cuelearner_envs.billiards.teacher import NearbyTeacher
from cuelearner_envs.pooltool import environment as foreign
from cuelearner_jax.errors import UserError
from cuelearner_jax.tasks import registry

CONFIG = BilliardsConfig("regulation")
NO_POOLTOOL = "pooltool is not installed: pip install 'cuelearner-jax[pooltool]'"
needs_pooltool = pytest.mark.skipif(find_spec("pooltool") is None, reason=NO_POOLTOOL)

# The cue ball, a target, a corner pocket: one line. The others are out of the way.
CORNER = np.array([0.44, 0.22])
WAY = CORNER / np.linalg.norm(CORNER)
LINE = np.array([CORNER - 0.3 * WAY, CORNER - 0.1 * WAY, [-0.3, -0.1], [-0.3, 0.1]], np.float32)
STRAIGHT = float(np.arctan2(WAY[1], WAY[0]))


@pytest.fixture(scope="module")
def env():
    return foreign.make_environment(CONFIG).replace(processes=1)


def state(positions=LINE):
    return Balls(jnp.asarray(positions), jnp.zeros(4, bool), jnp.zeros((), jnp.int32))


def test_what_cannot_be_is_refused_in_one_line(monkeypatch):
    monkeypatch.setattr(foreign, "find_spec", lambda name: object())
    with pytest.raises(UserError, match="pooltool's table is level: leave out --task"):
        foreign.make_environment(BilliardsConfig(acceleration=(0.0, 0.005)))
    monkeypatch.setattr(foreign, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pooltool is not installed: pip install 'cuelearner-jax\[pooltool\]'"):
        registry.find("billiards").on("pooltool").environment(CONFIG)


def test_to_agents_it_is_the_same_table(monkeypatch):
    monkeypatch.setattr(foreign, "find_spec", lambda name: object())
    theirs, ours = foreign.make_environment(CONFIG), make_billiards(CONFIG)
    assert theirs.observation == ours.observation
    reset = jax.jit(lambda env: env.reset(jax.random.key(3)))
    for one, other in zip(jax.tree.leaves(reset(theirs)), jax.tree.leaves(reset(ours)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_its_teacher_plays_shots_there_whatever_the_learned_one_thinks(monkeypatch):
    monkeypatch.setattr(foreign, "find_spec", lambda name: object())
    world = cl.make("billiards", robot="pooltool", teacher="learned")
    teacher = cl.teacher_of(world)
    assert isinstance(teacher, NearbyTeacher)
    assert isinstance(teacher.env, ForeignBilliards)
    with pytest.raises(UserError, match="unknown robot 'pooltol', did you mean 'pooltool'"):
        cl.make("billiards", robot="pooltol")


@needs_pooltool
def test_a_straight_shot_pockets_its_ball_in_both_engines(env):
    action = jnp.asarray(WAY, jnp.float32)
    for one in (env, make_billiards(CONFIG)):
        after, step = one.step(jax.random.key(0), state(), action)
        assert (float(step.reward), bool(step.terminated)) == (1.0, False)
        np.testing.assert_array_equal(after.pocketed, [False, True, False, False])
        np.testing.assert_array_equal(after.positions[2:], LINE[2:])


@needs_pooltool
def test_a_lonely_ball_slides_rolls_and_rests_where_the_equations_say(env):
    """v^2 12 / (49 mu_s g) of sliding, then (5 v / 7)^2 / (2 mu_r g) of rolling."""
    start = np.array([[-0.4, 0.0], [0.4, 0.19], [0.4, -0.19], [0.0, 0.19]], np.float32)
    slow = env.replace(engine=foreign.Pooltool(env.engine.outline._replace(strike_speed=0.4)))
    shot = slow.shot(state(start), jnp.float32(0.0))  # exactly along two cushions
    way = 0.4**2 * (12 / (49 * 0.2 * 9.81) + (5 / 7) ** 2 / (2 * 0.01 * 9.81))
    np.testing.assert_allclose(shot.positions[0], start[0] + [way, 0.0], atol=1e-5)
    np.testing.assert_array_equal(shot.positions[1:], start[1:])
    assert not shot.exhausted


@needs_pooltool
def test_spin_comes_from_the_cloth(env):
    """A ball that was hit full keeps rolling after it: on our table, without a cloth, the cue ball stops."""
    start = np.array([[-0.4, 0.0], [-0.1, 0.0], [0.4, 0.19], [0.4, -0.19]], np.float32)
    there, here = env.shot(state(start), jnp.float32(0.0)), make_billiards(CONFIG).shot(state(start), jnp.float32(0.0))
    contact = -0.1 - 2 * env.engine.outline.ball_radius
    assert abs(float(here.positions[0, 0]) - contact) < 1e-3
    assert float(there.positions[0, 0]) > contact + 0.02


@needs_pooltool
@pytest.mark.slow
def test_processes_play_the_same_shots(env):
    positions = np.repeat(LINE[None], 6, axis=0)
    angles = STRAIGHT + np.linspace(-0.1, 0.1, 6)
    alone, shared = (play_many(env.engine, positions, np.zeros((6, 4), bool), angles, count) for count in (1, 2))
    for one, other in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(one, other)
