"""What an environment may offer beside what it must, and what follows from its named slices."""

import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.environment import (
    UNKNOWN_UNIT,
    Features,
    Quantity,
    check_layout,
    offers,
    random_symmetries,
    spaces_of,
    symmetries_of,
)
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import DIRECTIONS, Box
from cuelearner_jax.spaces.directions import difference, rotate

ROWS = 200

TRAINED = (Quantity("gripper", 2, "m"), Quantity("goal", 2, "m"))
GIVEN = tuple(quantity._replace(unit=UNKNOWN_UNIT) for quantity in TRAINED)


def layout(*observation, actions=DIRECTIONS):
    return SimpleNamespace(observation=observation, actions=actions)


@pytest.mark.parametrize(
    ("known", "env", "says"),
    [
        (TRAINED, layout(*TRAINED[::-1]), r"the run observes 'gripper' \(m\) as entry 1, this world has 'goal' \(m\)"),
        (GIVEN, layout(*GIVEN[::-1]), "the run observes 'gripper' "),
        (TRAINED, layout(TRAINED[0], Quantity("goal", 2, "mm")), r"as entry 3, this world has 'goal' \(mm\)"),
        (TRAINED, layout(*TRAINED[:1]), "observes 4 entries, this world has 2"),
        (TRAINED, layout(*TRAINED, actions=Box((-1.0, -1.0), (1.0, 1.0))), r"takes actions between \(-1, -1\) and"),
    ],
)
def test_a_world_of_another_layout_is_refused(known, env, says):
    with pytest.raises(UserError, match=says):
        check_layout("the run", known, DIRECTIONS, env)


def test_a_layout_is_compared_as_far_as_it_is_known():
    unnamed = (Quantity("observation", 4, UNKNOWN_UNIT),)
    for known, env in ((TRAINED, layout(*unnamed)), (unnamed, layout(*TRAINED)), (TRAINED, layout(*GIVEN))):
        check_layout("the run", known, DIRECTIONS, env)
    check_layout("the run", TRAINED, Box((-1.0,), (1.0,)), layout(*TRAINED, actions=Box((-1.0,), (1.0,))))


# What is optional.


def test_a_member_that_is_none_is_not_offered():
    class Silent(probes.Window):
        heuristic = None
        mirror = None

    assert not offers(Silent(mirrors=True), "heuristic")
    assert symmetries_of(Silent(mirrors=True)) == 1  # of four announced


# Symmetries.


def test_every_symmetry_is_drawn_and_maps_a_row_as_a_whole():
    obs, action, other = jnp.array(np.random.default_rng(0).normal(size=(3, ROWS, 2)), jnp.float32)
    image = random_symmetries(jax.random.key(0), probes.Window(mirrors=True), ROWS)
    seen, moved = image(obs, action)
    quarters = np.round(np.asarray(difference(obs, seen)) / (math.pi / 2)).astype(int) % 4
    assert np.bincount(quarters, minlength=4).min() > 30  # 50 each, standard deviation 6
    turns = jnp.array(quarters * math.pi / 2)
    np.testing.assert_allclose(seen, rotate(obs, turns), atol=1e-5)
    np.testing.assert_allclose(moved, rotate(action, turns), atol=1e-5)
    # The same symmetry for whatever else belongs to a row.
    again, further = image(obs, other)
    np.testing.assert_array_equal(again, seen)
    np.testing.assert_allclose(further, rotate(other, turns), atol=1e-5)


def test_environments_of_equal_fields_have_spaces_of_their_own():
    """JAX takes such classes for the same tree; with a shared trace a tenth of them got the sizes of another."""

    def turned(size):
        class Turned(probes.Window):
            def features(self, obs, action):
                return Features(jnp.zeros(size), action)

        return Turned()

    assert jax.tree.structure(turned(1)) == jax.tree.structure(turned(2))
    for size in range(1, 61):
        assert spaces_of(turned(size)).features == (size, 2)
        assert spaces_of(probes.Window()).features == (2, 4)
