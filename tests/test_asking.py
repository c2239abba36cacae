"""A label's way: asking one by one, as a page does, is asking in rounds; what counts as a label; whose actions."""

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import asking
from cuelearner_jax.adaptation import by_reading
from cuelearner_jax.adaptation.judging import Judging
from cuelearner_jax.adaptation.lanes import product
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import PREFERENCE
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.policies import Common, Heuristic, Taught, Uniform
from cuelearner_jax.spaces import directions

ENV, EXPERT, HEURISTIC = probes.Window(), probes.Expert(probes.Window()), Heuristic(probes.Window())
RELATIVE = guidances.make("relative", probes.SIZES, ENV)
ROUND = probes.SIZES.labels_per_round
FAULTY = dataclasses.replace(
    probes.SCALARS, mistake_probability=0.2, silence_probability=0.2, refined_fraction=0.7, teacher_bias_deg=5.0
)
LANE_KEY = jax.random.key(11)


def asks(scalars, base, env=ENV):
    return asking.Inquiry(RELATIVE, env, scalars, base)


label_round = probes.label_rounds(RELATIVE, probes.SIZES)
# What a page calls, each compiled by itself.
question = jax.jit(lambda env, scalars, base, guide, keys: asking.question(asks(scalars, base, env), guide, keys)[0])


@jax.jit
def record(guide, position, action, answer, answered):
    """One answer, in one situation."""
    rows = (jnp.asarray(row)[None] for row in (guide.obs, action, answer, answered))
    return asking.record(guide, position, *rows, None)


proceed = jax.jit(asking.proceed)
fit = jax.jit(partial(asking.fit, RELATIVE))
said = jax.jit(RELATIVE.form.answer)


def begun(budget=2 * ROUND, env=ENV):
    return asking.start(RELATIVE, env, 2 * ROUND, budget, jax.random.key(1), jax.random.key(2))


def asked_one_by_one(guide, number, base, scalars, env=ENV, teacher=EXPERT):
    """A round of questions, the answers to which somebody types."""
    for position in range(number * ROUND, (number + 1) * ROUND):
        keys = asking.question_keys(LANE_KEY, position)
        action = question(env, scalars, base, guide, keys)
        answer, answered = said(keys.answer, env, teacher, guide.env, guide.obs, action, scalars)
        guide = proceed(env, record(guide, position, action, np.asarray(answer), bool(answered)), action, keys)
    return fit(env, scalars, guide, LANE_KEY, jnp.asarray(number))


@pytest.mark.parametrize(
    "base", [Uniform(), pytest.param(Heuristic(ENV), marks=pytest.mark.long)], ids=["uniform", "heuristic"]
)
def test_asking_one_by_one_is_bitwise_a_round(base):
    rounds = typed = begun(budget=17)
    for number in range(2):
        rounds = label_round(ENV, EXPERT, FAULTY, base, rounds, LANE_KEY)
        typed = asked_one_by_one(typed, number, base, FAULTY)
        chex.assert_trees_all_equal(typed, rounds)
    valid = np.asarray(rounds.labels.valid)
    assert not valid[17:].any()
    assert 5 < valid[:17].sum() < 17  # some answers were kept back
    assert bool(rounds.model.fitted)


def test_a_lanes_round_in_the_training_program_is_this_round_of_uniform_actions():
    program = probes.window_program("relative")
    state = probes.start(program, [3, 4, 5, 6], [2 * ROUND] * 4)
    guide, key = jax.tree.map(lambda leaf: jnp.copy(leaf[0]), (state.guide, state.key))
    clock = start_clock()
    for _ in range(2):
        clock, state = program.label_round(ENV, EXPERT, FAULTY, clock, state)
        guide = label_round(ENV, EXPERT, FAULTY, Uniform(), guide, key)
    chex.assert_trees_all_equal(probes.lane(state.guide, 0), jax.tree.map(np.asarray, guide))


def test_questions_are_about_what_the_base_policy_does():
    labels = label_round(ENV, EXPERT, probes.SCALARS, Heuristic(ENV), begun(), LANE_KEY).labels
    np.testing.assert_allclose(directions.difference(labels.obs, labels.action)[:ROUND], -1.0, atol=1e-5)
    assert len(np.unique(np.asarray(labels.obs)[:ROUND], axis=0)) > 1
    assert set(np.asarray(labels.answer)[:ROUND, 0]) == {1.0}  # 1.6 rad short of the best direction
    uniform = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), begun(), LANE_KEY).labels
    keys = [asking.question_keys(LANE_KEY, position).base for position in range(ROUND)]
    drawn = np.concatenate([directions.uniform(key, (1,)) for key in keys])
    np.testing.assert_allclose(uniform.action[:ROUND], drawn, atol=1e-6)


def test_after_a_question_comes_what_its_action_leads_to():
    env = probes.Chain(jnp.array(False))
    guide = begun(env=env)
    keys = asking.question_keys(LANE_KEY, 0)
    action = jnp.array([0.0, 1.0])
    after = asking.proceed(env, guide, action, keys)
    np.testing.assert_array_equal(guide.obs, env.observe(0))
    np.testing.assert_array_equal(after.obs, env.observe(1))
    assert int(after.env) == 1
    chex.assert_trees_all_equal((after.model, after.labels, after.budget), (guide.model, guide.labels, guide.budget))
    state, step = ENV.step(keys.env, ENV.reset(jax.random.key(4))[0], action)  # by the question's own random numbers
    moved = asking.proceed(ENV, begun().replace(env=ENV.reset(jax.random.key(4))[0]), action, keys)
    np.testing.assert_array_equal(moved.env, state)
    np.testing.assert_array_equal(moved.obs, step.obs)


def test_answers_past_the_budget_do_not_count():
    guide = begun(budget=4)
    for position in range(6):
        guide = record(guide, position, jnp.array([1.0, 0.0]), jnp.array([1.0]), True)
    assert np.asarray(guide.labels.valid).tolist() == [True] * 4 + [False] * (2 * ROUND - 4)
    # The round beyond a spent budget leaves everything as it is, the model too.
    spent = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), begun(budget=ROUND), LANE_KEY)
    chex.assert_trees_all_equal(label_round(ENV, EXPERT, probes.SCALARS, Uniform(), spent, LANE_KEY), spent)


def test_shuffled_answers_are_those_given_each_with_another_label():
    """A control that can fail: how often each answer is given stays, and no answer is about its action."""
    answer, valid = np.arange(20.0)[:, None], np.arange(20) % 7 != 3  # told apart; three count for nothing
    labels = begun(budget=20).labels.replace(answer=jnp.asarray(answer), valid=jnp.asarray(valid))
    assert asking.fitted_labels(LANE_KEY, labels, FAULTY) is labels
    scalars = dataclasses.replace(FAULTY, answer="shuffled")
    given = asking.fitted_labels(LANE_KEY, labels, scalars)
    found = np.asarray(given.answer)
    chex.assert_trees_all_equal(given.replace(answer=labels.answer), labels)
    np.testing.assert_array_equal(np.sort(found[valid], 0), answer[valid])
    assert (found[valid] != answer[valid]).all()
    np.testing.assert_array_equal(by_reading._valid(LANE_KEY, labels, scalars)[2], found[valid])  # as readings get them
    np.testing.assert_array_equal(found[~valid], answer[~valid])
    pairs = labels.replace(answer=jnp.concatenate([labels.answer, labels.answer + 0.5], -1))  # the second actions stay
    exchanged = asking.fitted_labels(LANE_KEY, pairs, scalars, PREFERENCE).answer
    np.testing.assert_array_equal(exchanged, np.concatenate([found, answer + 0.5], -1))
    assert (np.asarray(asking.fitted_labels(jax.random.key(12), labels, scalars).answer) != found).any()


class Lidar(probes.Window):
    """Sees a distance at the start, then the last action."""

    start: float = 1.0

    def reset(self, key):
        return super().reset(key)[0], jnp.full(2, self.start)

    def step(self, key, state, action):
        state, step = super().step(key, state, action)
        return state, step.replace(obs=action)


class Lost(probes.Expert):
    """Knows no action."""

    def best_action(self, state, obs):
        return obs * jnp.nan


def test_a_reading_names_who_fails_and_tells_that_nobody_answers():
    def read(start=1.0, base=HEURISTIC, teacher=EXPERT, silence=0.0):
        env, scalars = Lidar(start=start), dataclasses.replace(probes.SCALARS, silence_probability=silence)
        of = guidances.make("reading", probes.SIZES, env), probes.SIZES, scalars, env, Common(base), ()
        lanes, how = product(1, (0,), (20,), (60.0,)), Judging(None, by="labels")
        return by_reading.adapt(by_reading.ReadingAdaptation(*of), lanes, how, teacher)

    lost = Lost(ENV)
    for failing, name in (
        ({"start": jnp.inf}, "this world gave an observation"),
        ({"base": Taught(lost)}, "policy Taught"),
        ({"teacher": lost}, "teacher Lost"),
    ):
        with pytest.raises(UserError, match=name):
            read(**failing)
    with pytest.raises(UserError, match="this world gave an observation"):
        asking.blame(ENV, None, begun().replace(obs=jnp.full(2, jnp.inf)))
    assert read(silence=1.0).words == ["20 labels within 60 degrees: No question was answered."]
