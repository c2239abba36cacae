"""N-step returns: by hand, out of the ring buffer, and in the whole loop on a chain whose values are known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.agents.networks import q_network
from cuelearner_jax.agents.replay import LaterSteps, Memory, StoredStep, Transition, buffer_for, n_step_return
from cuelearner_jax.environment import spaces_of

HALF = 0.5  # the discount factor of everything worked out by hand
WEIGHT = 0.5  # of the n-step target in the whole loop

summed = jax.jit(n_step_return)


def window(rewards=(1.0, 2.0, 4.0), discounts=(1, 1, 1), ended=(0, 0, 0), known=(True, True, True)):
    """One window of three steps."""
    rewards, discounts, ended = (jnp.array(values, jnp.float32) for values in (rewards, discounts, ended))
    return LaterSteps(rewards, discounts, ended, jnp.array(known))


def returned(following, discount=HALF):
    """(sum, factor of the value that follows, last step)."""
    total, factor, last = summed(*following, discount)
    return float(total), float(factor), int(last)


# By hand.


def test_a_whole_window_sums_its_discounted_rewards_and_the_value_after_it_is_discounted_thrice():
    assert returned(window()) == (1 + 2 / 2 + 4 / 4, 1 / 4, 2)


def test_after_a_termination_neither_rewards_nor_a_value_count():
    assert returned(window((1, 2, 1e6), (1, 0, 1), (0, 1, 0))) == (2, 0, 1)
    assert returned(window((1, 1e6, 1e6), (0, 1, 1), (1, 0, 0))) == (1, 0, 0)
    assert returned(window((1, 2, 4), (1, 1, 0), (0, 0, 1))) == (3, 0, 2)


def test_after_a_truncation_the_value_counts_but_no_reward_does():
    assert returned(window((1, 2, 1e6), (1, 1, 1), (0, 1, 0))) == (2, 1 / 2, 1)
    assert returned(window((1, 1e6, 1e6), (1, 1, 1), (1, 0, 0))) == (1, 1, 0)
    assert returned(window((1, 2, 4), (1, 1, 1), (0, 0, 1))) == (3, 1 / 4, 2)


def test_steps_that_have_not_been_made_yet_shorten_the_window():
    assert returned(window((1, 2, 1e6), (1, 1, 0), (0, 0, 1), (True, True, False))) == (2, 1 / 2, 1)
    assert returned(window((1, 1e6, 1e6), (1, 0, 0), (0, 1, 1), (True, False, False))) == (1, 1, 0)
    assert returned(window((1, 1e6, 1e6), (0, 1, 1), (1, 0, 0), (True, True, False))) == (1, 0, 0)


# Out of the ring buffer.

ENVS, CAPACITY, WINDOW = 3, 24, 4
OPTIONS = probes.AGENT
CHAIN = probes.Chain(jnp.array(False))
AGENT = OPTIONS.make("raw", spaces_of(CHAIN), bootstraps=True)
BUFFER = buffer_for(CHAIN, bootstraps=True)


def course(count):
    """`count` steps of each environment: their episodes are 1 to 6 steps long and end either way."""
    rng = np.random.default_rng(4)
    ended = rng.random((count, ENVS)) < 0.3
    terminated = ended & (rng.random((count, ENVS)) < 0.5)
    rewards = rng.normal(size=(count, ENVS))
    number = np.arange(count)[:, None] + 100.0 * np.arange(ENVS)  # tells a step from every other
    return ended, terminated, rewards, number


def stored(count):
    ended, terminated, rewards, number = course(count)
    rows, add = BUFFER.empty(CAPACITY), jax.jit(BUFFER.add)
    for index in range(count):
        memory = StoredStep(
            obs=np.stack([number[index], number[index]], -1),
            action=np.stack([number[index] + 0.25, number[index]], -1),
            reward=rewards[index],
            discount=1.0 - terminated[index, :, None],
            ended=ended[index, :, None],
            aftermath=np.stack([number[index] + 0.5, number[index]], -1),
        )
        memory = jax.tree.map(lambda leaf: jnp.array(leaf, jnp.float32), memory)
        rows = add(rows, jnp.array(index * ENVS), memory)
    return rows


@jax.jit
def n_step(rows, filled, numbers, discount):
    return Memory(CHAIN, BUFFER, rows, filled, ENVS, bootstraps=True).n_step(numbers, WINDOW, discount)


@pytest.mark.parametrize("count", [5, 13])  # not yet full, in the second turn
def test_transitions_out_of_the_ring_buffer_are_those_of_a_walk_along_each_environments_steps(count):
    ended, terminated, rewards, number = course(count)
    kept = range(max(0, count - CAPACITY // ENVS), count)
    begins = [(index, env) for index in kept for env in range(ENVS)]
    numbers = jnp.array([(index * ENVS + env) % CAPACITY for index, env in begins])
    numbers = jnp.resize(numbers, (CAPACITY,))  # one shape, one compilation
    found = n_step(stored(count), jnp.array(count * ENVS), numbers, 0.9)
    cuts = set()
    for row, (index, env) in enumerate(begins):
        total, factor, place = 0.0, 1.0, index
        while True:
            total += factor * rewards[place, env]
            last = place
            if ended[place, env] or place + 1 == count or place + 1 == index + WINDOW:
                break
            place, factor = place + 1, factor * 0.9
        cuts.add((bool(ended[last, env]), bool(terminated[last, env]), last - index))
        assert float(found.reward[row]) == pytest.approx(total, abs=1e-5)
        assert float(found.discount[row]) == pytest.approx(0.0 if terminated[last, env] else factor, abs=1e-6)
        np.testing.assert_array_equal(found.obs[row], [number[index, env]] * 2)
        np.testing.assert_array_equal(found.action[row], [number[index, env] + 0.25, number[index, env]])
        np.testing.assert_array_equal(found.next_obs[row], [number[last, env] + 0.5, number[last, env]])
    assert {(end, termination) for end, termination, _ in cuts} == {(False, False), (True, False), (True, True)}


# The average of the two targets.


def constant(value):
    """Parameters of a value function that is `value` everywhere."""
    params = q_network(OPTIONS.q_layers).init(jax.random.key(0), jnp.zeros(2), jnp.zeros(2))
    params = jax.tree.map(jnp.zeros_like, params)
    layer = params["params"][f"Dense_{len(OPTIONS.q_layers)}"]
    return {"params": {**params["params"], f"Dense_{len(OPTIONS.q_layers)}": {**layer, "bias": jnp.array([value])}}}


@pytest.mark.parametrize(("weight", "expected"), [(0.0, [5.0, 2.0]), (1.0, [4.0, 3.0]), (0.25, [4.75, 2.25])])
def test_the_target_lies_between_that_of_one_step_and_that_of_many_by_the_weight(weight, expected):
    def batch(reward, discount):
        zeros = jnp.zeros((2, 2))
        return Transition(zeros, zeros, jnp.array(reward), jnp.array(discount), 1 + zeros)

    # Value 8 to the target network, which is what counts, and -3 to the online one. One step: 1 + 0.5 * 8 and a
    # termination with 2; three steps: 3 + 0.5 * 0.25 * 8 and 3 with a termination.
    near, far = batch([1.0, 2.0], [1.0, 0.0]), batch([3.0, 3.0], [0.25, 0.0])
    inputs = (None, dataclasses.replace(OPTIONS, n_step_weight=weight), HALF, constant(-3.0), constant(8.0))
    np.testing.assert_allclose(AGENT.targets(*inputs, [near, far]), expected, rtol=1e-6)
    np.testing.assert_allclose(AGENT.targets(*inputs, [near]), [5.0, 2.0], rtol=1e-6)


# The whole loop.

LOOP = dataclasses.replace(probes.CHAIN, agent=dataclasses.replace(probes.CHAIN.agent, n_step=3, n_step_weight=WEIGHT))


def test_values_of_a_chain_that_is_truncated():
    # Place 1 goes on as if it had no end, whatever the window: Q(1, a) = a_x + 1, at most 2. Place 0: a_y / 2 plus
    # 0.5 * 2 by one step; plus 0.5 * 0 + 0.25 * 2 by two, for the episode's end cuts the window of three.
    (start, end), _ = probes.chain_values(probes.chain_program(LOOP, "none"), LOOP, truncates=True)
    np.testing.assert_allclose(end, [2, 1, 0, 1], atol=0.12)
    np.testing.assert_allclose(start, np.array([0, 0.5, 0, -0.5]) + 1.0 - 0.5 * WEIGHT, atol=0.12)
