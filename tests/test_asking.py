"""A label's way: asking one by one, as a page does, is asking in rounds; what counts as a label; whose actions."""

import dataclasses
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import actions, asking, loop
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.policies import Agent, Heuristic, Taught, Teaching, Uniform

ENV, EXPERT = probes.Window(), probes.Expert(probes.Window())
RELATIVE = guidances.make("relative", probes.SIZES, ENV)
ROUND = probes.SIZES.labels_per_round
FAULTY = dataclasses.replace(
    probes.SCALARS, mistake_probability=0.2, silence_probability=0.2, refined_fraction=0.7, teacher_bias_deg=5.0
)
LANE_KEY = jax.random.key(11)

label_round = jax.jit(partial(asking.label_round, RELATIVE, probes.SIZES))
# What a page calls, each compiled by itself.
question = jax.jit(partial(asking.question, RELATIVE))
record = jax.jit(asking.record)
proceed = jax.jit(asking.proceed)
fit = jax.jit(partial(asking.fit, RELATIVE))
said = jax.jit(RELATIVE.form.answer)


def begun(budget=2 * ROUND, env=ENV, guidance=RELATIVE):
    slots = asking.label_slots(budget, probes.SIZES)
    return asking.start(guidance, env, slots, budget, jax.random.key(1), jax.random.key(2))


def asked_one_by_one(guide, number, base, scalars, env=ENV, teacher=EXPERT):
    """A round of questions, the answers to which somebody types."""
    for position in range(number * ROUND, (number + 1) * ROUND):
        keys = asking.question_keys(LANE_KEY, position)
        action = question(env, scalars, base, guide, keys)
        answer, answered = said(keys.answer, env, teacher, guide.env, guide.obs, action, scalars)
        typed = np.asarray(answer), bool(answered)
        guide = proceed(env, record(guide, position, action, *typed), action, keys)
    return fit(env, scalars, guide, LANE_KEY, jnp.asarray(number))


@pytest.mark.parametrize("base", [Uniform(), Heuristic(ENV)], ids=["uniform", "heuristic"])
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
    for base, turn in ((Heuristic(ENV), -1.0), (Taught(EXPERT), 0.6)):
        labels = label_round(ENV, EXPERT, probes.SCALARS, base, begun(), LANE_KEY).labels
        np.testing.assert_allclose(actions.difference(labels.obs, labels.action)[:ROUND], turn, atol=1e-5)
        assert len(np.unique(np.asarray(labels.obs)[:ROUND], axis=0)) > 1
        # 1.6 rad short of the best direction, or right there.
        assert set(np.asarray(labels.answer)[:ROUND, 0]) == {1.0 if turn < 0 else 0.0}
    uniform = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), begun(), LANE_KEY).labels
    keys = [asking.question_keys(LANE_KEY, position).base for position in range(ROUND)]
    drawn = np.concatenate([actions.uniform(key, (1,)) for key in keys])
    np.testing.assert_allclose(uniform.action[:ROUND], drawn, atol=1e-6)


def test_an_unguided_question_is_the_base_policys_own_action():
    none = guidances.make("none", probes.SIZES, ENV)
    guide = begun(guidance=none)
    keys = asking.question_keys(LANE_KEY, 0)
    action = asking.question(none, ENV, probes.SCALARS, Heuristic(ENV), guide, keys)
    np.testing.assert_array_equal(action, ENV.heuristic(guide.obs))
    with pytest.raises(ValueError, match="'none' asks nothing"):
        asking.ask(none, ENV, EXPERT, probes.SCALARS, Uniform(), guide, LANE_KEY, jnp.asarray(0))


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


def test_questions_may_lie_steps_apart():
    """The chain's two places follow each other, so that every second step is at the first."""
    env, sizes = probes.Chain(jnp.array(False)), dataclasses.replace(probes.SIZES, question_every=2)
    bundle = guidances.make("relative", sizes, env)
    base = Heuristic(env)
    ask = jax.jit(partial(asking.label_round, bundle, sizes))
    found = ask(env, Teaching(base), probes.SCALARS, base, begun(env=env, guidance=bundle), LANE_KEY)
    np.testing.assert_array_equal(found.labels.obs[:ROUND], np.tile(env.observe(0), (ROUND, 1)))
    assert int(found.asked) == ROUND


def test_an_answer_stands_in_its_row_and_changes_nothing_else():
    guide = begun()
    told = record(guide, 3, jnp.array([0.6, 0.8]), jnp.array([-1.0]), True)
    row = jax.tree.map(lambda leaf: np.asarray(leaf[3]), told.labels)
    np.testing.assert_array_equal(row.obs, guide.obs)
    np.testing.assert_array_equal(row.action, np.array([0.6, 0.8], np.float32))
    assert (row.answer.tolist(), bool(row.valid)) == ([-1.0], True)
    others = np.arange(2 * ROUND) != 3
    rest = [jax.tree.map(lambda leaf: np.asarray(leaf)[others], one.labels) for one in (told, guide)]
    chex.assert_trees_all_equal(*rest)
    assert int(told.asked) == 4  # questions with the numbers 0 to 3
    chex.assert_trees_all_equal(told.replace(labels=None, asked=0), guide.replace(labels=None, asked=0))


def test_answers_past_the_budget_do_not_count():
    guide = begun(budget=4)
    for position in range(6):
        guide = record(guide, position, jnp.array([1.0, 0.0]), jnp.array([1.0]), True)
    assert np.asarray(guide.labels.valid).tolist() == [True] * 4 + [False] * (ROUND - 4)
    # The round beyond a spent budget leaves everything as it is, the model too.
    spent = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), begun(budget=ROUND), LANE_KEY)
    after = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), spent, LANE_KEY)
    chex.assert_trees_all_equal(after, spent)


def test_questions_without_an_answer_do_not_count():
    guide = begun()
    for position in range(ROUND):
        guide = record(guide, position, jnp.array([1.0, 0.0]), jnp.array([1.0]), False)
    assert not np.asarray(guide.labels.valid).any()
    assert not bool(fit(ENV, probes.SCALARS, guide, LANE_KEY, jnp.asarray(0)).model.fitted)
    once = record(guide, ROUND, jnp.array([1.0, 0.0]), jnp.array([1.0]), True)
    assert bool(fit(ENV, probes.SCALARS, once, LANE_KEY, jnp.asarray(0)).model.fitted)


def test_answers_that_do_not_count_teach_nothing():
    guide = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), begun(budget=ROUND + 2), LANE_KEY)
    position = ROUND + 1
    one, other = (record(guide, position, jnp.array([1.0, 0.0]), jnp.array([h]), False) for h in (1.0, -1.0))
    fits = [fit(ENV, probes.SCALARS, told, LANE_KEY, jnp.asarray(1)).model for told in (one, other)]
    chex.assert_trees_all_equal(*fits)
    counted = record(guide, position, jnp.array([1.0, 0.0]), jnp.array([1.0]), True)
    assert counted.labels.valid[position]
    learned = fit(ENV, probes.SCALARS, counted, LANE_KEY, jnp.asarray(1)).model
    assert not np.array_equal(jax.tree.leaves(learned.params)[1], jax.tree.leaves(fits[0].params)[1])


def test_each_question_and_each_fit_has_random_numbers_of_its_own():
    drawn = [asking.question_keys(LANE_KEY, position) for position in range(3)]
    words = {tuple(np.asarray(jax.random.key_data(key)).tolist()) for keys in drawn for key in keys}
    assert len(words) == 3 * 4
    guide = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), begun(), LANE_KEY)
    models = [fit(ENV, probes.SCALARS, guide, LANE_KEY, jnp.asarray(number)).model for number in (0, 0, 1)]
    chex.assert_trees_all_equal(models[0], models[1], guide.model)
    assert not np.array_equal(jax.tree.leaves(models[0].params)[1], jax.tree.leaves(models[2].params)[1])


def test_labels_given_elsewhere_are_fitted_once():
    labels = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), begun(), LANE_KEY).labels
    taken = jax.jit(partial(asking.take_labels, RELATIVE))(ENV, probes.SCALARS, labels, begun(), LANE_KEY)
    given = begun().replace(labels=labels, asked=begun().budget)
    chex.assert_trees_all_equal(taken, fit(ENV, probes.SCALARS, given, LANE_KEY))
    assert bool(taken.model.fitted)


# Strengths that fall.

FALLING = dataclasses.replace(probes.SIZES, eps_falls=True)
FROM_40_TO_10 = dataclasses.replace(probes.SCALARS, eps_deg=40.0, eps_last_deg=10.0)


def begun_falling(budget):
    slots = asking.label_slots(budget, FALLING)
    return asking.start(RELATIVE, ENV, slots, budget, jax.random.key(1), jax.random.key(2), FALLING)


@pytest.mark.parametrize(
    ("budget", "strengths"),
    [
        (3, [40.0, 20.0, 10.0]),
        (5, [40.0, 28.284271, 20.0, 14.142136, 10.0]),
        (2, [40.0, 10.0, 10.0]),  # what is past the budget is as strong as its last
        (1, [40.0]),
    ],
)
def test_strengths_fall_by_the_same_factor_from_the_first_label_of_a_budget_to_the_last(budget, strengths):
    found = [asking.strength(FROM_40_TO_10, position, budget) for position in range(len(strengths))]
    np.testing.assert_allclose(found, strengths, rtol=1e-6)
    assert (found[0], found[budget - 1]) == (40.0, 10.0 if budget > 1 else 40.0)  # to the last bit
    same = dataclasses.replace(FROM_40_TO_10, eps_last_deg=40.0)
    assert {float(asking.strength(same, position, 7)) for position in range(7)} == {40.0}


def test_a_teacher_answers_by_the_strength_of_each_label_which_the_label_keeps():
    """8 degrees off: right for a label of more than 16 degrees, a turn for one of less, as from number 13 of 20 on."""
    base, near = Heuristic(ENV), probes.Expert(probes.Window(offset=-1.0 - np.deg2rad(8.0)))
    scalars = dataclasses.replace(FROM_40_TO_10, refined_fraction=0.0)
    guide = begun_falling(20)
    for _ in range(2):
        guide = asking.label_round(RELATIVE, FALLING, ENV, near, scalars, base, guide, LANE_KEY)
    np.testing.assert_allclose(guide.labels.eps_deg, 40.0 * 0.25 ** (np.arange(20) / 19), rtol=1e-5)
    assert np.asarray(guide.labels.answer)[:, 0].tolist() == [0.0] * 13 + [-1.0] * 7
    assert guide.labels.valid.all()


def test_a_lanes_own_budget_says_how_strengths_fall_and_instalments_do_not():
    ask = jax.jit(partial(asking.label_round, RELATIVE, FALLING))
    several = [begun_falling(budget) for budget in (15, 2 * ROUND)]
    for number in range(2):
        several = [ask(ENV, EXPERT, FROM_40_TO_10, Uniform(), guide, LANE_KEY) for guide in several]
        if number == 0:
            assert int(several[0].labels.valid.sum()) == ROUND
    for guide, budget in zip(several, (15, 2 * ROUND), strict=True):
        strengths = np.asarray(guide.labels.eps_deg)[:budget]
        np.testing.assert_allclose(strengths, np.geomspace(40.0, 10.0, budget), rtol=1e-5)
    waited = begun_falling(2 * ROUND)
    for until in (ROUND, ROUND, 2 * ROUND):
        waited = ask(ENV, EXPERT, FROM_40_TO_10, Uniform(), waited, LANE_KEY, jnp.asarray(until))
    chex.assert_trees_all_equal(waited, several[1])


def test_labels_of_one_strength_are_taken_where_strengths_fall_and_not_the_other_way_round():
    labels = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), begun(), LANE_KEY).labels
    taken = asking.as_kept(labels, begun_falling(2 * ROUND), probes.SCALARS)
    assert taken.eps_deg.tolist() == [20.0] * 2 * ROUND
    assert asking.as_kept(labels, begun(), probes.SCALARS) is labels
    with pytest.raises(ValueError, match=r"make the guide with sizes\.eps_falls"):
        asking.as_kept(taken, begun(), probes.SCALARS)


# Instalments.


def test_instalments_are_equal_up_to_whole_rounds_and_end_with_the_budget():
    shares = lambda budget, count: [asking.share(budget, i, count, probes.SIZES) for i in range(count)]  # noqa: E731
    assert shares(100, 1) == [100]
    assert shares(35, 1) == [35]
    assert shares(100, 2) == [50, 100]
    assert shares(100, 4) == [30, 50, 80, 100]
    assert shares(25, 2) == [20, 25]
    for budget in range(21, 200):
        found = np.diff([0, *shares(budget, 3)])
        assert found.sum() == budget
        assert found.min() > 0
        rounds = -(-found // ROUND)
        assert rounds.max() - rounds.min() <= 1


def test_a_guide_asks_until_its_instalment_is_done_and_then_waits():
    guide = begun(budget=2 * ROUND)
    one = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), guide, LANE_KEY, jnp.asarray(ROUND))
    waited = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), one, LANE_KEY, jnp.asarray(ROUND))
    chex.assert_trees_all_equal(waited, one)
    assert int(one.asked) == int(one.labels.valid.sum()) == ROUND
    # What it has waited for changes nothing: it goes on as if it had asked all at once.
    done = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), waited, LANE_KEY, jnp.asarray(2 * ROUND))
    at_once = guide
    for _ in range(2):
        at_once = label_round(ENV, EXPERT, probes.SCALARS, Uniform(), at_once, LANE_KEY, jnp.asarray(2 * ROUND))
    chex.assert_trees_all_equal(done, at_once)
    assert int(done.asked) == 2 * ROUND


def test_later_questions_are_about_the_agents_greedy_actions_refined_within_the_bound():
    program = probes.window_program("relative")
    clock, state = start_clock(), probes.start(program, [3, 4, 5, 6], [2 * ROUND, 15] * 2)
    clock, state = program.label_round(ENV, EXPERT, probes.SCALARS, clock, state)
    assert np.asarray(state.guide.labels.valid).sum(1).tolist() == [ROUND] * 4
    first = jax.tree.map(np.asarray, state.guide.labels)
    bounded = dataclasses.replace(probes.SCALARS, ask_bound_deg=7.0)
    plain = dataclasses.replace(bounded, refined_fraction=0.0)
    params = jax.tree.map(jnp.copy, state.agent.params)
    for scalars, turned in ((plain, False), (bounded, True)):
        kept = jax.tree.map(jnp.copy, state)
        _, later = program.label_round(ENV, EXPERT, scalars, clock, kept, state.guide.budget, own=True)
        for lane, budget in enumerate((2 * ROUND, 15)):
            labels, before = probes.lane(later.guide.labels, lane), probes.lane(first, lane)
            assert labels.valid.tolist() == [True] * budget + [False] * (
                probes.LARGEST - budget
            )  # never past the budget
            chex.assert_trees_all_equal(*(jax.tree.map(lambda leaf: leaf[:ROUND], one) for one in (labels, before)))
            greedy = Agent(probes.lane(params, lane), probes.SIZES).act(
                LANE_KEY, None, jnp.asarray(labels.obs[ROUND : 2 * ROUND])
            )
            away = np.degrees(np.abs(actions.difference(greedy, labels.action[ROUND : 2 * ROUND])))
            assert away.max() <= 7.0 + 1e-3
            assert (away.max() > 1.0) == turned
        assert later.guide.asked.tolist() == [2 * ROUND, 15] * 2


def test_guided_episodes_keep_to_the_bound_once_there_are_labels_about_the_agents_own_actions():
    config = probes.config(scalars={"ask_bound_deg": 9.0}, schedule={"ask_at": (0, 16)})
    lane = loop.make_lane(config, guidances.make("heuristic", config.sizes, ENV), ENV, 0)
    state = jax.tree.map(lambda leaf: leaf[0], probes.start(probes.window_program("heuristic"), [3], [0]))
    state = state.replace(agent=state.agent.replace(guided=jnp.array([True, True, False, True])))
    base = actions.rotate(state.agent.obs, 0.5)  # 1.5 rad from the heuristic's
    one = dataclasses.replace(config.schedule, ask_at=(0,))
    for schedule, step, away in ((config.schedule, 15, 1.5), (config.schedule, 16, np.deg2rad(9.0)), (one, 16, 1.5)):
        clock = start_clock().replace(step=jnp.asarray(step))
        found = lane.guide(ENV, config.scalars, schedule, clock, state, base)
        turned = np.abs(actions.difference(base, found.actions))
        np.testing.assert_allclose(turned, [away, away, 0, away], atol=1e-5)
