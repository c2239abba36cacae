"""Refinement: against a float64 NumPy loop, by hand on known residual fields, and its bounds as laws."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.devices import portions
from cuelearner_jax.guides import refining
from cuelearner_jax.guides.refining import refine
from cuelearner_jax.spaces import DIRECTIONS, directions

DEG = math.pi / 180
ROWS = 256


def network(seed, scale):
    """A smooth random field: weights of a tiny MLP of the action."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(2, 12)), rng.normal(size=12), scale * rng.normal(size=(12, 2)) / math.sqrt(12)


def residual_of(weights, tanh, array):
    first, bias, second = map(array, weights)
    return lambda action: tanh(action @ first + bias.reshape(*[1] * (action.ndim - 1), -1)) @ second


def refine_by_network(weights, first, active, tau, tau_max, k_max):
    residual = residual_of(weights, jnp.tanh, jnp.asarray)
    return refine(residual, first, active, space=DIRECTIONS, tau=tau, tau_max=tau_max, k_max=k_max)


refined_by_network = jax.jit(refine_by_network)


def starts(seed, count=ROWS):
    angles = np.random.default_rng(seed).uniform(-math.pi, math.pi, count)
    return np.stack([np.cos(angles), np.sin(angles)], -1)


def turn(start, end):
    return np.arctan2(start[..., 0] * end[..., 1] - start[..., 1] * end[..., 0], (start * end).sum(-1))


def refined_by_loop(residual, first, tau, tau_max, k_max):
    """Eqs. 2-5 of the paper, one row at a time. Returns (action, passes, how close a decision about tau was)."""
    current, passes, closest = first, 0, math.inf
    while passes < k_max:
        proposal = current + residual(current)
        proposal = proposal / np.linalg.norm(proposal)
        away = turn(first, proposal)
        if abs(away) > tau_max:
            angle = math.atan2(first[1], first[0]) + math.copysign(tau_max, away)
            proposal = np.array([math.cos(angle), math.sin(angle)])
        step = abs(turn(current, proposal))
        closest = min(closest, abs(step - tau))
        current, passes = proposal, passes + 1
        if step < tau:
            break
    return current, passes, closest


@pytest.mark.parametrize(
    ("scale", "tau_deg", "tau_max_deg", "k_max"),
    [(0.2, 0.5, 180.0, 50), (0.5, 0.5, 180.0, 50), (0.3, 2.0, 30.0, 50), (0.2, 0.1, 90.0, 4), (0.3, 0.5, 180.0, 0)],
)
def test_agrees_with_a_float64_loop(scale, tau_deg, tau_max_deg, k_max):
    weights, first = network(int(100 * scale), scale), starts(1)
    result = refined_by_network(weights, first, np.ones(ROWS, bool), tau_deg * DEG, tau_max_deg * DEG, k_max)
    residual = residual_of(weights, np.tanh, np.asarray)
    loops = [refined_by_loop(residual, row, tau_deg * DEG, tau_max_deg * DEG, k_max) for row in first]
    expected, passes, closest = (np.array(column) for column in zip(*loops, strict=True))
    clear = closest > 1e-5  # elsewhere float32 may stop a pass earlier or later
    assert clear.mean() > 0.95
    np.testing.assert_array_equal(np.asarray(result.passes)[clear], passes[clear])
    assert np.abs(turn(expected, np.asarray(result.actions)))[clear].max() < 1e-4


def test_passes_between_two_looks_change_nothing(monkeypatch):
    weights, first, some = network(20, 0.2), starts(1), np.arange(ROWS) % 3 > 0
    inputs = (weights, first, some, 0.5 * DEG, math.pi, 50)
    each = refined_by_network(*inputs)
    asked = []

    def seven_passes():
        asked.append(True)
        return portions()._replace(passes=7)

    monkeypatch.setattr(refining, "portions", seven_passes)
    # A new function: of the same one JAX would run the trace with one pass again.
    several = jax.jit(functools.partial(refine_by_network))(*inputs)
    assert asked
    np.testing.assert_array_equal(several.passes, each.passes)
    np.testing.assert_allclose(several.actions, each.actions, atol=1e-6)
    assert each.passes.max() > 7


@pytest.mark.parametrize(("scale", "radius"), [(0.1, DEG), (30.0, 0.0), (30.0, DEG), (30.0, 179 * DEG)])
def test_no_iterate_leaves_the_ball(scale, radius):
    weights, first = network(int(scale), scale), starts(2)
    farthest = 0.0
    for k_max in range(1, 9):
        result = refined_by_network(weights, first, np.ones(ROWS, bool), 0.0, radius, k_max)
        assert result.passes.tolist() == [k_max] * ROWS
        away = np.abs(turn(first, np.asarray(result.actions, np.float64)))
        assert away.max() <= radius + 1e-5
        farthest = max(farthest, away.max())
    if scale >= 1:
        assert farthest > 0.99 * radius  # the bound was met


def test_rows_that_are_not_active_come_back_bitwise():
    first = jnp.asarray(starts(3), jnp.float32)
    active = np.arange(ROWS) % 3 == 0
    result = refined_by_network(network(3, 0.5), first, active, 0.5 * DEG, math.pi, 50)
    alone = refined_by_network(network(3, 0.5), first, np.ones(ROWS, bool), 0.5 * DEG, math.pi, 50)
    np.testing.assert_array_equal(np.asarray(result.actions)[~active], np.asarray(first)[~active])
    np.testing.assert_array_equal(np.asarray(result.passes)[~active], 0)
    np.testing.assert_array_equal(np.asarray(result.actions)[active], np.asarray(alone.actions)[active])
    assert np.asarray(result.passes)[active].min() > 0


def told(goal, eps):
    """What a perfect model of relative feedback answers: a turn by eps toward a goal that is not within eps / 2."""

    def residual(action):
        error = directions.difference(action, goal)
        return directions.rotate(action, jnp.where(jnp.abs(error) <= eps / 2, 0.0, jnp.sign(error)) * eps) - action

    return residual


def test_under_vmap_each_lane_has_its_own_number_of_passes():
    first = directions.from_angle(jnp.array([[47.0], [3.0]]) * DEG)

    def one(start):
        active = jnp.ones(1, bool)
        residual = told(directions.from_angle(jnp.zeros(())), 10.0 * DEG)
        return refine(residual, start, active, space=DIRECTIONS, tau=0.1 * DEG, tau_max=math.pi, k_max=50)

    assert jax.vmap(one)(first).passes.tolist() == [[6], [1]]
