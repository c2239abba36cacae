"""The simulator that pooltool's table is explained by, and a teacher who says nothing where nothing near succeeds."""

import calibration_pooltool as experiment
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cuelearner_jax as cl
from cuelearner_envs.billiards.environment import Balls
from cuelearner_jax.calibration.families import undo_physics
from cuelearner_jax.policies import policy_of
from cuelearner_jax.spaces.directions import difference, from_angle

OWN = cl.make("billiards", table="regulation").env
# A cut into a corner: the target stands on the way to the pocket, the cue ball aside. The others are out of the way.
PLACES = np.array([[0.0, 0.0], [0.28, 0.08], [-0.3, -0.1], [-0.3, 0.1]], np.float32)
STATE = Balls(jnp.asarray(PLACES), jnp.zeros(4, bool), jnp.zeros((), jnp.int32))
OBS = jax.jit(OWN.observe)(STATE)


@jax.jit
def best(theta):
    """The shot near the target that our table, with a cloth, pays; of several the middle one."""
    angles = jnp.arctan2(*PLACES[1, ::-1]) + jnp.deg2rad(jnp.linspace(-4, 4, 161))
    env = experiment.table_of(OWN, theta)
    paid = jax.vmap(lambda angle: env.step(jax.random.key(0), STATE, from_angle(angle))[1].reward)(angles)
    return from_angle((paid * angles).sum() / paid.sum())


@pytest.mark.parametrize("theta", [(0.0, 0.0, 0.0), (-0.25, 2 / 7, -0.3)])
def test_shots_turn_as_the_cloth_moves_the_best_one(theta):
    theta = jnp.asarray(theta)
    family = experiment.family_of(OWN)[:1]
    meant = best(jnp.zeros(3))
    given = undo_physics(family, theta, OBS, meant)
    moved = np.rad2deg(difference(meant, best(theta)))
    assert np.isclose(np.rad2deg(difference(meant, given)), moved, atol=0.15)
    assert (np.abs(moved) > 0.2) == bool(theta.any())


@pytest.mark.parametrize(("away", "answers"), [(0.5, True), (20.0, False)])
def test_the_teacher_says_nothing_where_no_shot_near_succeeds(away, answers):
    shot = np.asarray(from_angle(jnp.arctan2(*best(jnp.zeros(3))[::-1]) + jnp.deg2rad(away)))
    proposer = experiment.Teaching(policy_of(lambda obs: jnp.tile(shot, (len(obs), 1))))
    teacher = experiment.FrankTeacher(proposer, OWN, jnp.deg2rad(0.15), jnp.deg2rad(1.0), 21)
    assert bool(jnp.isfinite(teacher.best_action(STATE, OBS)).all()) == answers


def test_the_share_of_the_loss_is_counted_from_the_network_as_it_is():
    rows = [
        {"what": what, "rewards": [value]} for what, value in (("own table", 0.6), ("not adapted", 0.2), ("x", 0.3))
    ]
    assert "x: share of the loss 0.250" in experiment.shares(rows)
