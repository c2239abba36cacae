"""Where to strike a target so that it goes into a pocket: by hand, by the impulses, by symmetry, by playing it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_envs.billiards.aims import aims_of, contact_for
from cuelearner_envs.billiards.contacts import normal_impulse, tangential_impulse
from cuelearner_envs.billiards.table import Table
from cuelearner_jax.spaces import directions

REGULATION = Table.regulation()
CUE = (-0.2, 0.05)
# x, y and flag of the cue ball and three targets; pockets: corners (+,+) (+,-) (-,+) (-,-), then the sides up and down.
SEEN = jnp.array([*CUE, -0.5, 0.0, 0.1, -0.5, 0.3, -0.1, -0.5, -0.1, -0.15, -0.5])
aims_seen = jax.jit(aims_of)
UP, MIRRORED = 4, {1: [2, 3, 0, 1, 4, 5], 2: [1, 0, 3, 2, 5, 4], 3: [3, 2, 1, 0, 5, 4]}


def by_ball(aims):
    """The leaves with axes (targets, pockets, ...)."""
    return [np.asarray(leaf).reshape(3, 6, *leaf.shape[1:]) for leaf in aims[:3]]


def test_a_ball_straight_in_front_of_a_pocket_is_struck_straight():
    seen = SEEN.at[0:5].set(jnp.array([0.0, -0.1, -0.5, 0.0, 0.1]))
    strikes, features, possible = (leaf[0, UP] for leaf in by_ball(aims_seen(REGULATION, seen)))
    np.testing.assert_allclose(strikes, [0.0, 1.0], atol=1e-6)
    assert possible
    # No cut; 0.2 m less a ball's diameter to the contact, 0.12 m to the pocket, in heights of the table.
    np.testing.assert_allclose(features[:4], [0.0, 1.0, (0.2 - 0.0225) / 0.44, 0.12 / 0.44], atol=1e-5)
    assert np.isclose(features[5], (0.025 - 0.01125 - 0.004) / 0.01125)  # room between the jaws, in radii


@pytest.mark.parametrize("turn", [0.0, 0.3, -0.7, 1.1])
def test_a_target_leaves_along_its_way_by_the_impulses_of_an_impact(turn):
    way = directions.from_angle(jnp.array(0.4 + turn))
    contact = contact_for(REGULATION, jnp.array([-0.3, -0.1]), jnp.array([0.1, 0.05]), way)
    tangent = directions.rotate(contact.normal, jnp.pi / 2)
    along, across = contact.strike @ contact.normal, contact.strike @ tangent
    push = normal_impulse(along, 0.0, 1.0, 2.0)
    drag = -tangential_impulse(across, push, REGULATION.friction, 2.0)
    leaves = directions.retract(push * contact.normal + drag * tangent)
    np.testing.assert_allclose(directions.difference(way, leaves), 0.0, atol=2e-4)


@pytest.mark.parametrize("which", [1, 2, 3])
def test_a_mirrored_table_mirrors_strikes_and_keeps_features(which):
    signs = jnp.array([1.0 - 2.0 * (which % 2), 1.0 - 2.0 * (which // 2)])
    image = SEEN.reshape(4, 3).at[:, :2].multiply(signs).ravel()
    strikes, features, possible = by_ball(aims_seen(REGULATION, SEEN))
    mirrored = [leaf[:, MIRRORED[which]] for leaf in by_ball(aims_seen(REGULATION, image))]
    np.testing.assert_allclose(mirrored[0], strikes * np.asarray(signs), atol=1e-5)
    np.testing.assert_allclose(mirrored[1], features, atol=1e-3)
    np.testing.assert_array_equal(mirrored[2], possible)


def test_a_pocketed_ball_is_no_aim_and_in_nobodys_way():
    between = SEEN.at[6:9].set(jnp.array([-0.1, 0.075, -0.5]))  # on the way from the cue ball to the first target
    blocked, free = (by_ball(aims_seen(REGULATION, seen)) for seen in (between, between.at[8].set(0.5)))
    assert not free[2][1].any()
    # clearance of the cue ball's way, in diameters, less 1
    assert blocked[1][0, UP, 7] < -0.5 < 0.9 < free[1][0, UP, 7]
