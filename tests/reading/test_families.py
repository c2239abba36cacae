"""What an environment declares can have changed: each change is undone exactly, and none leaves everything alone."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from cuelearner_envs.billiards.config import BilliardsConfig, make_environment
from cuelearner_envs.navigation.environment import Navigation
from cuelearner_jax.environment import OWN, Quantity, WholeObservations
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import policy_of
from cuelearner_jax.reading.families import (
    Distortion,
    Unknown,
    check_family,
    declared_distortions,
    undo_action,
    undo_observation,
    unknowns_of,
)
from cuelearner_jax.reading.linear import steps_of
from cuelearner_jax.reading.policy import unread
from cuelearner_jax.reading.result import _changes_of_observation, _names
from cuelearner_jax.spaces import DIRECTIONS, Box, Space
from cuelearner_jax.spaces.directions import from_angle, retract, rotate

BEAMS, STEP_DEG = 36, 10.0
BOX = Box((-1.0, 0.0, 2.0), (1.0, 0.5, 4.0))


class Yard(WholeObservations, struct.PyTreeNode):
    """Two balls in metres, a goal's direction, and a ring of beams."""

    actions: Space = struct.field(pytree_node=False, default=DIRECTIONS)
    observation = (
        Quantity("ball", 2, "m"),
        Quantity("pocket", 2, "m"),
        Quantity("wind", 2, "1", "unit vector", "directions"),
        Quantity("lidar", BEAMS, "1", "nearness", "beams", STEP_DEG),
    )


@partial(jax.jit, static_argnums=1)
def drawn(key, count):
    """Observations of random situations."""
    k_place, k_wind, k_beams = jax.random.split(key, 3)
    places = jax.random.uniform(k_place, (count, 4), minval=-0.4, maxval=0.4)
    wind = retract(jax.random.normal(k_wind, (count, 2)))
    angle = jnp.arange(BEAMS) * (2 * jnp.pi / BEAMS)
    centre = jax.random.uniform(k_beams, (count, 1), maxval=2 * jnp.pi)
    return jnp.concatenate([places, wind, jnp.exp(2 * (jnp.cos(angle[None] - centre) - 1))], -1)


@jax.jit
def aims(obs):
    """Toward a point between ball and pocket, blown aside by the wind, away from what is near: a direction."""
    ball, pocket, wind, beams = obs[:, :2], obs[:, 2:4], obs[:, 4:6], obs[:, 6:]
    angle = jnp.arange(BEAMS) * (2 * jnp.pi / BEAMS)
    near = jnp.stack([beams @ jnp.cos(angle), beams @ jnp.sin(angle)], -1) / BEAMS
    return retract(retract(0.15 - ball) + 0.7 * retract(pocket + 0.1) + 0.4 * wind - 1.5 * near)


@jax.jit
def grips(obs):
    """Three numbers of a box."""
    ball, wind = obs[:, :2], obs[:, 4:6]
    shares = 0.5 + jnp.stack([0.5 * ball[:, 0], 0.4 * ball[:, 1], 0.2 * wind[:, 0] + 0.2 * ball[:, 0]], -1)
    low, high = jnp.array(BOX.low)[None], jnp.array(BOX.high)[None]
    return low + shares * (high - low)


def changed(obs, shift=(0.0, 0.0), lidar_deg=0.0, wind_deg=0.0):
    """Observations as they were before a change of the sensors, written without the package's own undoing."""
    obs = np.array(obs)
    obs[:, 0:4] -= np.tile(shift, 2)
    obs[:, 4:6] = np.asarray(rotate(jnp.asarray(obs[:, 4:6]), -jnp.deg2rad(wind_deg)))
    obs[:, 6:] = np.roll(obs[:, 6:], round(lidar_deg / STEP_DEG), axis=1)
    return jnp.asarray(obs)


def test_an_environment_declares_what_can_have_changed():
    names = [distortion.name for distortion in declared_distortions(Yard())]
    assert names == ["ball and 1 more: shift", "ball and 1 more: gain", "lidar: turn", "wind: turn"]
    units = [
        (unknown.name, unknown.unit)
        for unknown in unknowns_of(declared_distortions(make_environment(BilliardsConfig())))
    ]
    assert units == [
        ("cue ball: place and 3 more: shift x", "m"),
        ("cue ball: place and 3 more: shift y", "m"),
        ("cue ball: place and 3 more: gain", "percent"),
    ]
    assert [distortion.name for distortion in declared_distortions(Navigation(worlds=None))] == [  # pyright: ignore
        "lidar: turn",
        "goal: direction: turn",
    ]


@pytest.mark.parametrize(("space", "policy"), [(DIRECTIONS, aims), (BOX, grips)])
def test_without_a_change_the_policy_stays_what_it_was(space, policy):
    obs = drawn(jax.random.key(0), 8)
    base = policy_of(jax.jit(policy)).replace(actions=space)
    corrected = unread(base, space, declared_distortions(Yard(space)), obs.shape[1])
    np.testing.assert_array_equal(corrected.act(jax.random.key(0), None, obs), base.act(jax.random.key(0), None, obs))


@pytest.mark.parametrize(
    ("name", "theta", "change"),
    [
        ("ball and 1 more: shift", (0.05, -0.03), {"shift": (0.05, -0.03)}),
        ("lidar: turn", (2 * STEP_DEG,), {"lidar_deg": 2 * STEP_DEG}),
        ("lidar: turn", (-STEP_DEG,), {"lidar_deg": -STEP_DEG}),
        ("wind: turn", (25.0,), {"wind_deg": 25.0}),
    ],
)
def test_a_change_of_the_sensors_is_undone(name, theta, change):
    family = tuple(one for one in declared_distortions(Yard()) if one.name == name)
    obs = drawn(jax.random.key(0), 8)
    before = jax.vmap(lambda row: undo_observation(family, jnp.array(theta), row))(obs)
    np.testing.assert_allclose(before, changed(obs, **change), atol=1e-5)


def test_a_step_stays_where_the_policy_has_actions():
    family, obs = declared_distortions(Yard())[:1], drawn(jax.random.key(0), 8)
    steps = steps_of(DIRECTIONS, family, lambda obs: jnp.where(jnp.abs(obs[:, :1]) < 2, aims(obs), jnp.nan), obs, 0.05)
    np.testing.assert_array_equal(steps, steps_of(DIRECTIONS, family, aims, obs, 0.05))


def test_a_gain_is_told_as_the_change_of_the_factor():
    (gain,) = (one for one in declared_distortions(Yard()) if one.name.endswith("gain"))
    own, theta, one = Distortion("own", (Unknown("own", "percent"),)), 100 * np.log([2.0]), np.ones((1, 1))
    assert undo_observation((gain,), jnp.array(theta), jnp.full(42, 2.0))[0] == pytest.approx(1)
    for family, told in (((gain,), [100, 100 * np.expm1((theta - 1.96) / 100)]), ((own,), [theta, theta - 1.96])):
        (found,) = _changes_of_observation(theta, one, one, _names(family, 1, ()), family, np.ones(1))
        assert (found.mean, found.low) == (pytest.approx(told[0]), pytest.approx(told[1]))


class Table:
    """Two places that a camera tells, the difference of one from the hand, and the hand's own place."""

    actions = BOX
    observation = (
        Quantity("cup", 3, "m", origin=(1.0, 2.0)),
        Quantity("hand", 3, "m", kind=OWN),
        Quantity("cup less hand", 3, "m", follows="cup"),
        Quantity("plate", 2, "m", origin=(1.0, 2.0)),
    )


def test_places_turn_about_their_origin_and_differences_follow():
    (turn,) = [one for one in declared_distortions(Table()) if one.name.endswith("turn")]
    assert turn.name == "cup and 1 more: turn"
    assert [(unknown.unit, unknown.most) for unknown in turn.unknowns] == [("degrees", 180.0)]
    # Turned by 90 degrees, a cup 1 m ahead of the origin is seen 1 m to its left, and the plate 2 m behind the origin.
    shown = jnp.array([1.0, 3.0, 0.5, 0.2, 0.3, 0.4, 0.8, 2.7, 0.1, 1.0, 0.0])
    before = undo_observation((turn,), jnp.array([90.0]), shown)
    np.testing.assert_allclose(before, [2, 2, 0.5, 0.2, 0.3, 0.4, 1.8, 1.7, 0.1, -1, 2], atol=1e-6)
    np.testing.assert_array_equal(undo_observation((turn,), jnp.zeros(1), shown), shown)


def test_beams_between_two_are_interpolated_and_nothing_is_seen_beyond_the_last():
    (lidar,) = [one for one in declared_distortions(Navigation(worlds=None)) if one.name == "lidar: turn"]  # pyright: ignore
    before = undo_observation((lidar,), jnp.array([1.5]), jnp.zeros(280).at[:271].set(jnp.arange(271.0)))
    np.testing.assert_allclose(before[:4], [0.0, 0.0, 0.5, 1.5])  # turned by 1.5 beams: beam 2 is at 0.5
    assert before[270] == 268.5


def test_an_action_leads_where_the_policy_meant_it_to():
    turn = Distortion("turn", (Unknown("turn", "degrees"),), acts=lambda theta, a: rotate(a, -jnp.deg2rad(theta[0])))
    action = undo_action((turn,), jnp.array([30.0]), jnp.zeros(1), from_angle(1.0))
    np.testing.assert_allclose(rotate(action, jnp.deg2rad(30.0)), from_angle(1.0), atol=1e-6)


def test_families_that_make_no_sense_are_refused():
    one = Distortion("tilt", (Unknown("tilt", "degrees"),), sees=lambda theta, obs: obs)
    for family, message in (
        ([], "changes is empty"),
        ([one._replace(unknowns=())], "no unknowns"),
        ([one._replace(sees=None)], "changes nothing"),
        ([one, one], "name of two distortions"),
    ):
        with pytest.raises(UserError, match=message):
            check_family(family)
    joints = (Quantity("hip", 1, "rad"), Quantity("knee", 1, "rad"))  # each encoder has an offset of its own
    names = [one.name for one in unknowns_of(declared_distortions(SimpleNamespace(observation=joints)))]
    assert names == ["hip: shift", "knee: shift"]
    ball = Quantity("ball", 2, "m", origin=(0.0, 0.0))
    for slices, message in (
        ((Quantity("gravity", 3, "1", kind="directions"),), "'gravity' has 3 entries"),
        ((ball, Quantity("away", 1, "m", follows="ball")), "'away' follows another but is not a place"),
        ((ball, Quantity("speed", 2, "m/s", follows="ball")), "'speed' follows another but is not a place"),
    ):
        with pytest.raises(UserError, match=message):
            declared_distortions(SimpleNamespace(observation=slices))
