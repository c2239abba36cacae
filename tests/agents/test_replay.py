"""The ring buffer: order, wrap-around, and what may be drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cuelearner_jax.agents.replay import RingBuffer, StoredStep, count_guided, draw_sorts

EXAMPLE = StoredStep(jnp.zeros(3), jnp.zeros(2), jnp.zeros(()), jnp.zeros(1), jnp.zeros(1), jnp.zeros(3))


def numbered(first, count):
    """Steps whose every entry is their own number, apart from its place."""
    numbers = jnp.arange(first, first + count, dtype=jnp.float32)
    return StoredStep(
        obs=numbers[:, None] + jnp.array([[0.0, 0.1, 0.2]]),
        action=numbers[:, None] + jnp.array([[0.3, 0.4]]),
        reward=numbers + 0.5,
        discount=numbers[:, None] + 0.6,
        ended=numbers[:, None] + 0.7,
        aftermath=numbers[:, None] + jnp.array([[0.8, 0.9, 1.0]]),
    )


def filled(buffer, capacity, at_once, steps):
    rows, add = buffer.empty(capacity), jax.jit(buffer.add)
    for step in range(0, steps, at_once):
        rows = add(rows, jnp.array(step), numbered(step, at_once))
    return rows


def test_rows_lie_in_the_order_of_time_with_every_field():
    buffer = RingBuffer(EXAMPLE)
    assert buffer.width == 11
    rows = np.asarray(filled(buffer, capacity=6, at_once=2, steps=4))
    assert rows.shape == (6, 11)
    np.testing.assert_allclose(rows[:4], np.arange(4)[:, None] + np.arange(11) / 10, rtol=1e-6)
    np.testing.assert_array_equal(rows[4:], 0)


def test_the_oldest_rows_are_written_over():
    rows = filled(RingBuffer(EXAMPLE), capacity=6, at_once=2, steps=10)
    np.testing.assert_array_equal(np.asarray(rows)[:, 0], [6, 7, 8, 9, 4, 5])


@pytest.mark.parametrize(("steps", "numbers"), [(4, {0, 1, 2, 3}), (14, set(range(6, 14)))])
def test_only_filled_rows_are_drawn_and_all_of_them(steps, numbers):
    buffer = RingBuffer(EXAMPLE)
    rows = filled(buffer, 8, 1, steps)
    drawn = buffer.read(rows, buffer.draw(jax.random.key(1), rows, jnp.array(steps), 500))
    assert set((np.asarray(drawn.reward) - 0.5).tolist()) == numbers  # an empty row would be -0.5


def test_in_lanes_the_write_stays_one_slice_update():
    buffer = RingBuffer(EXAMPLE)
    rows = jnp.stack([buffer.empty(6), buffer.empty(6)])
    lanes = jax.tree.map(lambda *leaves: jnp.stack(leaves), numbered(10, 2), numbered(20, 2))
    add = jax.vmap(buffer.add, (0, None, 0))
    column = add(rows, jnp.array(10), lanes)[:, :, 0]
    np.testing.assert_array_equal(column, [[0, 0, 0, 0, 10, 11], [0, 0, 0, 0, 20, 21]])
    program = str(jax.make_jaxpr(add)(rows, jnp.array(10), lanes))
    assert "dynamic_update_slice" in program
    assert "scatter" not in program


def counted(guided, capacity, at_once):
    """Counts of guided steps, written so many at once."""
    counts, add = jnp.zeros((capacity, 1), jnp.int32), jax.jit(count_guided)
    for step in range(0, len(guided), at_once):
        counts = add(counts, jnp.array(step), jnp.asarray(guided[step : step + at_once]))
    return counts


def test_guided_steps_are_counted_up_to_each_row():
    guided = np.array([1, 0, 0, 1, 1, 0, 1, 0, 0, 1], bool)
    total = np.cumsum(guided)
    np.testing.assert_array_equal(counted(guided[:8], 8, 2)[:, 0], total[:8])
    np.testing.assert_array_equal(counted(guided, 8, 2)[:, 0], [*total[8:], *total[2:8]])


@pytest.mark.parametrize("steps", [5, 19])
def test_rows_of_each_sort_are_drawn_alike_and_no_others(steps):
    """Once the ring of 8 has been round, its oldest row is of an unknown sort, and left out."""
    guided = np.isin(np.arange(steps) % 7, (1, 2, 5))
    counts, oldest = counted(guided, 8, 1)[:, 0], max(steps - 8, 0) + (steps > 8)
    wanted = np.arange(6000) < 3000
    drawn = np.asarray(draw_sorts(jax.random.key(0), counts, jnp.array(steps), jnp.asarray(wanted)))
    for sort in (True, False):
        there = [number % 8 for number in range(oldest, steps) if guided[number] == sort]
        found = np.bincount(drawn[wanted == sort], minlength=8)
        assert set(np.flatnonzero(found)) == set(there)
        expected = 3000 / len(there)
        assert np.abs(found[there] - expected).max() < 5 * expected**0.5
