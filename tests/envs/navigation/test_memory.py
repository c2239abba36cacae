"""The memory of the way tried, and the ways that aims are: laws of geometry, and what stays as it was without them."""

import math
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.anymal import environment as anymal
from cuelearner_envs.navigation import World, memory
from cuelearner_envs.navigation.aims import ROOM, free_ways
from cuelearner_envs.navigation.config import NavigationConfig
from cuelearner_envs.navigation.environment import PLAIN, Navigation
from cuelearner_envs.navigation.lidar import BEAM_ANGLES
from cuelearner_jax.actions import from_angle
from cuelearner_jax.agents.networks import q_network
from cuelearner_jax.config import AgentSizes
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import Agent
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.tasks import registry

WORLD = World(
    boxes=jnp.array([[6.1, 0, 0, 0.1, 4.2], [-6.1, 0, 0, 0.1, 4.2], [0, 4.1, 0, 6.2, 0.1], [0, -4.1, 0, 6.2, 0.1]]),
    box_heights=jnp.full(4, 1.5),
    circles=jnp.array([[2.0, 0.0, 0.5]]),
    circle_heights=jnp.ones(1),
    extent=jnp.array([12.0, 8.0]),
    starts=jnp.array([[-4.0, 0.0]]),
    goals=jnp.array([[4.0, 0.0]]),
)
FORGETS = Navigation(worlds=jax.tree.map(lambda leaf: leaf[None], WORLD))
REMEMBERS = FORGETS.replace(memory=True)
AHEAD = jnp.array([1.0, 0.0])
TRAIL = memory.nothing().at[:3].set(jnp.array([[0.0, 0.0], [1.0, 0.3], [2.0, -0.4]]))
POSE = jnp.array([1.2, 0.5, 0.7])

around, turned_to = jax.jit(memory.around), jax.jit(memory.turned)


@jax.jit
def walked(env):
    """Twelve steps ahead: the states and observations, the first included."""

    def step(carry, _):
        state, _ = carry
        after, found = env.step(jax.random.key(0), state, AHEAD)
        return (after, found.obs), (after, found.obs)

    start = env.reset(jax.random.key(3))
    return jax.lax.scan(step, start, length=12)[1]


@pytest.fixture(scope="module")
def remembered():
    return walked(REMEMBERS)


def test_a_memory_adds_to_what_is_seen_and_changes_nothing(remembered):
    states, seen = walked(FORGETS)
    assert (FORGETS.obs_size, REMEMBERS.obs_size) == (PLAIN, PLAIN + memory.SEEN)
    assert FORGETS.plain_size == REMEMBERS.plain_size == PLAIN
    np.testing.assert_array_equal(remembered[1][:, :PLAIN], seen)
    np.testing.assert_array_equal(remembered[0].pose, states.pose)


def test_somebody_who_walked_straight_remembers_what_lies_behind(remembered):
    tried = remembered[1][-1, PLAIN:].reshape(2, memory.SECTORS)
    # He set out 2.4 m ago: about 1 m behind he has been, about 1 m ahead he has not.
    assert float(tried[0, [0, -1]].min()) > 0.5
    assert float(tried[0, 14:22].max()) < 0.1
    assert not np.asarray(around(memory.nothing(), POSE)).any()


def test_the_memory_turns_with_the_body_and_with_the_frame():
    angle = jnp.deg2rad(20.0)  # two sectors
    here = around(TRAIL, POSE)
    turned = around(TRAIL, POSE.at[2].add(angle))
    np.testing.assert_allclose(turned_to(here, from_angle(angle)), turned, atol=1e-5)
    many = turned_to(here, jnp.stack([AHEAD, from_angle(angle)]))
    np.testing.assert_allclose(many, np.stack([here, turned]), atol=1e-5)


def test_the_mirror_image_of_a_way_is_remembered_mirrored():
    flip = jnp.array([1.0, -1.0])
    image = around(TRAIL * flip[None], POSE * jnp.array([1.0, -1.0, -1.0]))
    np.testing.assert_allclose(memory.mirrored(around(TRAIL, POSE)), image, atol=1e-5)


def test_what_is_replayed_is_remembered_too(remembered):
    state, obs = jax.tree.map(lambda leaf: leaf[-1], remembered)
    again = jax.jit(lambda env, state, obs: env.recall(env.remember(state, obs)))(REMEMBERS, state, obs)
    np.testing.assert_allclose(again, obs, atol=1e-6)


def test_an_agent_without_a_memory_acts_as_before(remembered):
    sizes = AgentSizes(q_layers=(8,), directions=36)
    params = q_network(sizes.q_layers).init(jax.random.key(1), jnp.zeros(PLAIN), AHEAD)
    agent, obs = Agent(params, sizes), remembered[1]
    there = agent.replace(sees=PLAIN).act(jax.random.key(0), None, obs)
    chex.assert_trees_all_equal(there, agent.act(jax.random.key(0), None, obs[:, :PLAIN]))


def test_the_legged_robot_remembers_nothing():
    with pytest.raises(UserError, match="--robot simple"):
        anymal.make_environment(NavigationConfig(worlds=1, memory=True))


def test_a_disc_is_stopped_where_it_touches():
    """Before a wall at 3 m, and beside a post at 2 m that is 0.3 m off the line."""
    beams = from_angle(jnp.asarray(BEAM_ANGLES))
    wall = jnp.where(beams[:, 0] > 0.3, 3.0 / jnp.maximum(beams[:, 0], 0.3), 10.0)
    obs = jnp.concatenate([jnp.exp(-jnp.minimum(wall, 10.0)), jnp.zeros(9)])
    np.testing.assert_allclose(free_ways(obs, AHEAD[None])[:, 0], 3.0 - np.array([0.28, 0.42, 0.55]), atol=1e-3)
    post = jnp.full(271, 10.0).at[135 + 9].set(2.0)  # 9 degrees to the left
    obs = jnp.concatenate([jnp.exp(-post), jnp.zeros(9)])
    along, across = 2.0 * math.cos(math.radians(9)), 2.0 * math.sin(math.radians(9))
    stopped = [10.0, *(along - math.sqrt(radius**2 - across**2) for radius in (0.42, 0.55))]
    np.testing.assert_allclose(free_ways(obs, AHEAD[None])[:, 0], stopped, atol=1e-3)


def test_aims_are_ways_with_room_and_the_goal_comes_first(remembered):
    aims = jax.jit(jax.vmap(REMEMBERS.aims))(remembered[1])
    np.testing.assert_allclose(aims.actions[:, 0], remembered[1][:, 271:273], atol=1e-6)
    behind = np.abs(np.arctan2(aims.actions[..., 1], aims.actions[..., 0])) > math.radians(136)
    possible = np.asarray(aims.open)
    assert np.asarray(aims.possible).all()
    assert not possible[behind].any()
    free = jax.jit(jax.vmap(free_ways))(remembered[1], aims.actions)
    assert np.asarray(free[:, 0])[possible].min() > ROOM[0]
    plain = jax.jit(jax.vmap(FORGETS.aims))(remembered[1][:, :PLAIN])
    np.testing.assert_array_equal(plain.open, possible)
    np.testing.assert_array_equal(plain.features, aims.features[..., : plain.features.shape[-1]])


def test_agents_are_let_into_a_world_with_a_memory_and_their_guides_are_not():
    folder = Path(__file__).parents[3] / "docs" / "data" / "navigation_agent"
    source, changed = PolicySource.of_run(folder, registry.find), NavigationConfig(worlds=1, memory=True)
    source.check("agent", changed)
    with pytest.raises(UserError, match="have 280 entries, this world's 352"):
        source.check("guided", changed)
