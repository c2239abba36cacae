"""A policy that walks to an unrecorded goal seen aside: labels about its proposals find the shift of the state."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.environment import BASE, EFFECT
from cuelearner_jax.policies import Heuristic
from cuelearner_jax.reading import Reading, declared_distortions, families, fitting
from cuelearner_jax.tasks import logs

MOST, LABELS, STEP, SEEN = 0.05, 60, 0.05, np.array([0.08, -0.05])
PARTS = {"names": ("x", "y", "phase", EFFECT, BASE), "entries": (1, 1, 1, 4, 2)}
ENV = logs.filled(logs.LogsConfig(**PARTS, low=(-MOST, -MOST), high=(MOST, MOST)))
STATE = declared_distortions(ENV)


def policy(place, goal):
    return np.clip(0.5 * (goal - place), -MOST, MOST)


def situations(seed, count, aside):
    random = np.random.default_rng(seed)
    place, goal = random.uniform(0, 1, (count, 2)), random.uniform(0.1, 0.9, (count, 2))
    for _ in range(25):
        place = np.where(random.uniform(size=(count, 1)) < 0.5, place + policy(place, goal + aside), place)
    return place, goal


def read(aside, seed, family):
    """Return the reading of labels by a script that knows the goal; effects are zero for another family."""
    place, goal = situations(seed, LABELS, aside)
    action, right = policy(place, goal + aside), policy(place, goal)
    sides = [policy(place + way, goal + aside) - policy(place - way, goal + aside) for way in STEP * np.eye(2)]
    effect = np.concatenate(sides, 1) / (2 * STEP) * (family == STATE)
    rows = np.concatenate([place, 0 * place[:, :1], effect, action], 1)
    reading = Reading(Heuristic(ENV.view()), family, ENV.actions, 1 / 36, LABELS, ENV.observation)
    for key in jax.random.split(jax.random.key(seed), 3):
        at, action_there = reading.questions(rows, LABELS // 3, key)
        reading.learn(rows[at], action_there, np.sign(np.trunc((right[at] - action_there) / (2 * MOST) * 72)))
    return reading


def play(corrected):
    """Return the error of actions, in shares of the range, and the share of goals met within 2 cm after 50 steps."""
    (place, goal), (reached, other) = situations(10, 300, SEEN), situations(11, 300, 0.0)
    apply, none = jax.jit(partial(corrected.act, jax.random.key(0), None)), np.zeros((300, 5))
    shift = np.append(corrected.correction.change.theta, [0.0, 0.0])[:2]  # none by actions alone
    act = lambda place, goal: np.asarray(apply(np.concatenate([place, none, policy(place - shift, goal + SEEN)], 1)))  # noqa: E731
    error = np.abs(act(place, goal) - policy(place, goal)).mean() / (2 * MOST)
    for _ in range(50):
        reached = reached + act(reached, other)
    return error, (np.linalg.norm(reached - other, axis=1) < 0.02).mean()


def test_a_shift_of_the_state_is_found_and_only_where_there_is_one():
    reading, (state,) = read(SEEN, 2, STATE), STATE
    corrected, (told, _) = reading.policy(), reading.result().words()
    assert (told[:20], float(told.split()[4])) == ("state x seen aside: ", pytest.approx(-SEEN[0], abs=0.005))
    np.testing.assert_allclose(corrected.correction.change.theta, -SEEN, atol=0.02)
    assert play(corrected)[0] < 0.02  # 0.27 before
    nothing = read(0 * SEEN, 0, STATE)
    number = len(fitting.HYPOTHESES)  # none with a process: the policy cannot be asked
    assert (bool(nothing.result().used), len(nothing.fits.score)) == (False, number)
    obs = jnp.array([0.3, 0.4, 0.0, -0.5, 0.0, 0.0, -0.25, 0.02, 0.01])
    np.testing.assert_allclose(state.plans(jnp.array([0.04, -0.02]), obs, obs[-2:]), [0.04, 0.005], atol=1e-7)


@pytest.mark.long
def test_the_state_tells_more_than_actions_alone():
    found = [[play(read(SEEN, n, family).policy()) for n in range(3)] for family in (families.ACTIONS_ALONE, STATE)]
    (error, success), (error_state, success_state) = np.mean(found, 1)
    print(f"error {error:.3f} by actions alone, {error_state:.3f} by the state; success {success}, {success_state}")
    assert (error_state < error, success_state) == (True, 1.0)
