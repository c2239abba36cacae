"""Labelled steps that the agent learns from: what is executed and kept, how often it is drawn, what is refused."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax.agents.replay import Memory, buffer_for
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.runs.program import make_program
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.spaces.directions import difference, rotate

ENV, EXPERT = probes.Window(), probes.Expert(probes.Window())
CONFIG = probes.config(sizes={"store_labelled": True})
BUDGETS = [10, 20]


@cache
def labelled(kind):
    """Two lanes of one seed after all their labels, and the guide's state as NumPy arrays."""
    program = make_program(CONFIG, guidances.make(kind, CONFIG.sizes, ENV), ENV, max(BUDGETS))
    clock, state = start_clock(), probes.start(program, [3, 3], BUDGETS)
    for _ in range(2):
        clock, state = program.label_round(ENV, EXPERT, probes.SCALARS, clock, state)
    return program, clock, state, jax.tree.map(np.asarray, state.guide)


def steps_of(guide, lane):
    """Observations, actions and rewards of a lane's labelled steps."""
    rows = guide.stored[lane, : guide.asked[lane]]
    return rows[:, :2], rows[:, 2:4], rows[:, 4]


def test_a_relative_answer_moves_the_executed_action_by_eps():
    guide = labelled("relative")[3]
    for lane, budget in enumerate(BUDGETS):
        obs, action, reward = steps_of(guide, lane)
        said = jax.tree.map(lambda leaf, lane=lane, budget=budget: leaf[lane, :budget], guide.labels)
        np.testing.assert_array_equal(obs, said.obs)
        turned = rotate(jnp.asarray(said.action), said.answer[:, 0] * np.deg2rad(probes.SCALARS.eps_deg))
        np.testing.assert_allclose(action, turned, atol=1e-6)
        assert set(said.answer[:, 0]) == {-1.0, 0.0, 1.0}
        off = np.abs(difference(ENV.best(jnp.asarray(obs)), jnp.asarray(action)))
        np.testing.assert_array_equal(reward, off <= 0.5)


def test_a_demonstration_is_executed():
    form, eps = guidances.make("demonstration", CONFIG.sizes, ENV).form, np.deg2rad(probes.SCALARS.eps_deg)
    asked, shown = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
    np.testing.assert_allclose(form.correct(DIRECTIONS, asked, shown, eps), shown, atol=1e-6)


def test_an_unanswered_question_executes_the_asked_action():
    program = labelled("relative")[0]
    silent = dataclasses.replace(probes.SCALARS, silence_probability=1.0)
    _, state = program.label_round(ENV, EXPERT, silent, start_clock(), probes.start(program, [5, 6], BUDGETS))
    np.testing.assert_array_equal(state.guide.stored[:, :10, 2:4], state.guide.labels.action[:, :10])


# Minibatches.

BUFFER = buffer_for(ENV, False)


def rows_of(count, capacity, mark):
    """Rows of a replay, their actions all `mark`."""
    rows = np.zeros((capacity, BUFFER.width), np.float32)
    rows[:count, 2:4] = mark
    return jnp.asarray(rows)


def memory(own, labelled):
    """A memory with so many own steps and labelled ones."""
    apart = Memory(ENV, BUFFER, rows_of(labelled, 50, 7.0), jnp.array(labelled), 1, False)
    return Memory(ENV, BUFFER, rows_of(own, 200, 1.0), jnp.array(own), 1, False, labelled=apart)


def marks(memory, size, **how):
    """The marks of one minibatch."""
    (batch,) = memory.batches(jax.random.key(4), size, **how)
    return np.asarray(batch.action)[:, 0]


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (0.25, 2), (0.5, 4), (1.0, 8)])
def test_a_minibatch_has_its_share_of_labelled_steps(share, count):
    assert marks(memory(100, 30), 8, guided_share=jnp.float32(share)).tolist() == [7.0] * count + [1.0] * (8 - count)


def test_without_a_share_every_step_is_as_likely():
    drawn = marks(memory(100, 50), 6_000) == 7.0
    assert abs(drawn.mean() - 1 / 3) < 4 * np.sqrt(2 / 9 / 6_000)  # four standard errors
