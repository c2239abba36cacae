"""Pace: ratios by hand and by bootstrap, shares that follow which arm earns more, lanes that owe each other nothing."""

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import loop
from cuelearner_jax.arbiters import paced as pace
from cuelearner_jax.config import Scalars
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.tasks import registry
from cuelearner_jax.types import ArmSums

LASTING = Scalars(pace_window=1e12)  # nothing fades


@partial(jax.jit, static_argnames="bootstraps")
def followed(record, scalars, rewards, dones, guided, counts, bootstraps=False):
    """The record after steps (steps, envs), and the probability after each."""

    def step(record, row):
        record = pace.follow(record, scalars, bootstraps, *row)
        return record, pace.probability(record, scalars)

    return jax.lax.scan(step, record, (rewards, dones, guided, counts))


def episodes_of(rewards, lengths):
    """Rewards and ends (steps, 1) of episodes one after another in one environment."""
    return np.concatenate(rewards)[:, None], np.concatenate([np.arange(n) == n - 1 for n in lengths])[:, None]


def seen(rewards, lengths, guided, scalars=LASTING, bootstraps=False):
    """The record after episodes (their rewards, a list), each guided or not."""
    reward, done = episodes_of(rewards, lengths)
    arm = np.repeat(guided, lengths)[:, None]
    counts = np.ones(len(reward), bool)
    record, shares = followed(pace.start(1), scalars, reward.astype(np.float32), done, arm, counts, bootstraps)
    return record, np.asarray(shares)


def test_ratio_and_standard_error_by_hand():
    # Own episodes earn 1 of 1, 0 of 2, 2 of 3 steps; guided ones 1 of 1 and 1 of 1.
    rewards = [[1.0], [1.0], [0.0, 0.0], [1.0], [0.0, 1.0, 1.0]]
    record, _ = seen(rewards, [1, 1, 2, 1, 3], [False, True, False, True, False])
    ratio, variance = pace.scores(record.sums)
    np.testing.assert_allclose(record.sums.episodes, [3, 2])
    np.testing.assert_allclose(ratio, [0.5, 1.0], rtol=1e-6)  # 3 / 6, 2 / 2
    # Residuals 1 - 1/2, 0 - 1, 2 - 3/2: squares 1/4 + 1 + 1/4, over (3 - 1) and the square of the mean size 2.
    np.testing.assert_allclose(variance, [1.5 / 2 / 4, 0], atol=1e-6)


def test_the_standard_error_is_that_of_a_bootstrap():
    rng = np.random.default_rng(0)
    lengths = rng.integers(1, 11, 400)
    rewards = [rng.binomial(1, 0.1 + 0.05 * (n < 4), n).astype(float) for n in lengths]
    record, _ = seen(rewards, lengths, [False] * 400)
    ratio, variance = pace.scores(record.sums)
    gain = np.array([sum(each) for each in rewards])
    assert float(ratio[0]) == pytest.approx(gain.sum() / lengths.sum(), rel=1e-5)
    drawn = rng.integers(0, 400, (4000, 400))
    means = gain[drawn].sum(-1) / lengths[drawn].sum(-1)
    assert math.sqrt(variance[0] / 400) == pytest.approx(means.std(), rel=0.06)  # of 4,000 draws: 1.1%


def test_with_a_discount_an_episode_earns_its_discounted_return_however_long():
    scalars = dataclasses.replace(LASTING, discount=0.5)
    rewards = [[0.0, 0.0, 1.0], [-1.0], [1.0, 1.0], [1.0]]  # returns 1/4, -1, 3/2, 1
    record, _ = seen(rewards, [3, 1, 2, 1], [False, True, True, False], scalars, bootstraps=True)
    np.testing.assert_allclose(record.sums.gain, [1.25, 0.5])
    np.testing.assert_allclose(record.sums.size, [2, 2])
    np.testing.assert_allclose(record.sums.gain_gain, [1 / 16 + 1, 1 + 9 / 4])


def test_sums_fade_with_every_episode_of_either_arm():
    record, _ = seen([[1.0]] * 3, [1] * 3, [False, True, True], Scalars(pace_window=4.0))
    np.testing.assert_allclose(record.sums.episodes, [0.75**2, 0.75 + 1])


def test_episodes_with_a_step_that_does_not_count_are_left_out():
    reward, done = episodes_of([[1.0, 1.0], [1.0, 0.0], [0.0]], [2, 2, 1])
    counts = np.array([False, True, True, True, False])
    record, _ = followed(pace.start(1), LASTING, reward, done, np.zeros((5, 1), bool), counts)
    np.testing.assert_allclose(record.sums.episodes, [1, 0])
    np.testing.assert_allclose(record.sums.gain, [1, 0])


def sums(own, guided):
    """Of (episodes, wins) of one step each."""
    episodes, wins = np.array([own, guided], np.float32).T
    return ArmSums(*map(jnp.asarray, (episodes, wins, episodes, wins, wins, episodes)))


@pytest.mark.parametrize(
    ("own", "guided", "most", "expected"),
    [
        ((0, 0), (0, 0), 0.5, 0.5),  # nothing seen
        ((50, 50), (1, 0), 0.5, 0.5),  # hardly seen
        ((50, 0), (50, 0), 0.5, 0.5),  # draws
        ((50, 20), (50, 20), 0.5, 0.5),
        ((50, 5), (50, 45), 0.5, 0.5),  # better
        ((50, 45), (50, 5), 0.5, 0.02),  # worse
        ((50, 50), (50, 0), 0.5, 0.02),  # and neither varies
        ((50, 5), (50, 45), 1.0, 0.98),  # own episodes go on being seen
        ((50, 45), (50, 5), 0.0, 0.0),  # never more than unpaced
        ((50, 45), (50, 5), 0.01, 0.01),
    ],
)
def test_the_share_of_known_sums(own, guided, most, expected):
    record = pace.start(1).replace(sums=sums(own, guided))
    found = pace.probability(record, Scalars(guided_probability=most))
    assert float(found) == pytest.approx(expected, abs=1e-6)


def test_the_share_is_twice_the_chance_that_guidance_is_better():
    record = pace.start(1).replace(sums=sums((40, 20), (40, 16)))
    # Variances of one episode 0.25 * 40 / 39 and 0.24 * 40 / 39, pooled 0.245 * 40 / 39 at least.
    error = math.sqrt((0.25 + 0.245) / 39)
    chance = 0.5 * (1 + math.erf(-0.1 / error / math.sqrt(2)))
    assert float(pace.probability(record, Scalars())) == pytest.approx(0.5 * 2 * chance, rel=1e-4)


@pytest.mark.parametrize(
    ("own", "guided", "expected"),
    [
        ((1000, 0), (1000, 500), 0.5),  # the whole lead
        ((1000, 0), (1000, 800), 0.5),  # and more
        ((1000, 300), (1000, 500), 0.2),  # 0.2 of 0.5
        ((1000, 0), (1000, 100), 0.1),  # a weak guide of agents that know nothing
        ((1000, 500), (1000, 505), 0.02),  # a draw
        ((1000, 500), (1000, 100), 0.02),
        ((1000, 0), (1, 0), 0.5),  # hardly seen
    ],
)
def test_with_a_lead_the_share_is_what_own_episodes_are_behind(own, guided, expected):
    record = pace.start(1).replace(sums=sums(own, guided))
    found = pace.probability(record, Scalars(pace_lead=0.5))
    assert float(found) == pytest.approx(expected, abs=1e-5)


def test_few_episodes_that_went_alike_are_not_believed_for_certain():
    # Three guided failures against own luck of 0.3: by their own variance (0) guidance were worse for certain.
    record = pace.start(1).replace(sums=sums((200, 60), (3, 0)))
    assert float(pace.probability(record, Scalars())) > 0.1


@partial(jax.jit, static_argnames="episodes")
def played(key, scalars, own, guided, episodes):
    """Bandit episodes in four environments, guided as paced: the share after each step. Chances (steps,) to win."""

    def step(carry, row):
        record, arms, key = carry
        key, k_win, k_arm = jax.random.split(key, 3)
        won = jax.random.uniform(k_win, (4,)) < jnp.where(arms, row[1], row[0])
        done = jnp.ones(4, bool)
        record = pace.follow(record, scalars, False, won.astype(jnp.float32), done, arms, jnp.array(True))
        share = pace.probability(record, scalars)
        return (record, jax.random.bernoulli(k_arm, share, (4,)), key), share

    chances = jnp.stack(jnp.broadcast_arrays(own, guided, jnp.zeros(episodes // 4))[:2], -1)
    return jax.lax.scan(step, (pace.start(4), jnp.zeros(4, bool), key), chances)[1]


def test_a_guide_that_becomes_worse_half_way_is_followed_within_a_window():
    scalars = Scalars(pace_window=200.0)
    half = jnp.arange(1000) >= 500  # steps of four episodes
    keys = jax.random.split(jax.random.key(0), 16)
    turned = np.asarray(jax.vmap(lambda key: played(key, scalars, 0.5, jnp.where(half, 0.1, 0.9), 4000))(keys))
    assert turned[:, 100:500].mean() == pytest.approx(0.5, abs=0.01)
    assert turned[:, 550:600].mean() < 0.25  # one window on, half of what the arm remembers is from before
    assert turned[:, 700:].mean() < 0.08
    back = np.asarray(jax.vmap(lambda key: played(key, scalars, 0.5, jnp.where(half, 0.9, 0.1), 4000))(keys))
    assert back[:, 400:500].mean() < 0.08
    assert back[:, 650:].mean() > 0.4  # a guide that becomes better is tried, though seldom seen before


def test_every_preset_is_paced_but_those_that_are_the_papers():
    offered = map(registry.find, registry.names())
    found = {(task.name, name): preset.config.sizes.pace for task in offered for name, preset in task.presets.items()}
    assert found == {named: named[1] != "paper" for named in found}


# In the loop, on the bandit: the heuristic turns by -1 rad, and is right in a world of that offset alone.

PACED = probes.config(sizes={"pace": True}, scalars={"pace_window": 100.0})
SCHEDULE = dataclasses.replace(probes.SCHEDULE, learn_after=10**9, guidance_until=10**6)
STRETCH = 100


@pytest.fixture(scope="module")
def program():
    env = probes.Window()
    return loop.make_program(PACED, guidances.make("heuristic", PACED.sizes, env), env, 0)


def run(program, env, seeds, stretches, schedule=SCHEDULE, clock=None, state=None):
    clock = loop.start_clock() if clock is None else clock
    state = probes.start(program, seeds, [0] * len(seeds), env) if state is None else state
    for _ in range(stretches):
        clock, state, metrics = program.train(env, PACED.scalars, schedule, clock, state, STRETCH)
    return clock, state, metrics


def test_a_guide_that_earns_nothing_goes_to_the_floor_and_one_that_always_wins_stays(program):
    wrong, right = probes.Window(half_width=1.5), probes.Window(offset=-1.0)  # the heuristic is off by 1.6 in the first
    _, state, metrics = run(program, wrong, [0, 1], 5)
    own, guided = np.asarray(pace.scores(probes.lane(state.pace.sums, 0))[0])
    assert own > 0.1 > guided
    assert float(metrics["guided_share"][0]) < 0.1
    _, state, metrics = run(program, right, [0, 1], 5)
    np.testing.assert_allclose(jax.vmap(pace.scores)(state.pace.sums)[0][:, 1], 1, atol=1e-6)
    np.testing.assert_allclose(metrics["guided_share"], 0.5, atol=0.08)  # standard deviation 0.025


def test_after_the_cut_off_nothing_is_guided_nor_counted(program):
    right, short = probes.Window(offset=-1.0), dataclasses.replace(SCHEDULE, guidance_until=400)
    clock, state, _ = run(program, right, [0, 1], 1, short)
    before = jax.tree.map(np.asarray, state.pace.sums)
    _, state, metrics = run(program, right, [0, 1], 1, short, clock, state)
    assert float(metrics["guided_share"][0]) == 0
    jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.asarray, state.pace.sums))


def test_random_steps_are_no_arms(program):
    late = dataclasses.replace(SCHEDULE, random_steps=200)  # of 400
    _, state, metrics = run(program, probes.Window(), [0, 1], 1, late)
    rewards, faded = probes.stored(state, 0, 400)["reward"].reshape(100, 4)[50:], 0.0
    for row in rewards:
        faded = faded * 0.99**4 + row.sum()
    assert float(state.pace.sums.gain[0].sum()) == pytest.approx(faded, rel=1e-4)
    assert 0 < float(metrics["guided_share"][0]) < 0.5


def test_lanes_beside_each_other_are_lanes_alone(program):
    env = probes.Window()
    _, beside, _ = run(program, env, [3, 4], 2)
    _, alone, _ = run(program, env, [4], 2)
    for mine, yours in zip(
        jax.tree.leaves(probes.lane(beside, 1)), jax.tree.leaves(probes.lane(alone, 0)), strict=True
    ):
        np.testing.assert_array_equal(mine, yours)


def test_without_pace_nothing_of_it_is_there_and_a_pace_without_a_choice_is_none_to_the_last_bit(program):
    assert probes.start(probes.window_program("heuristic"), [0, 1], [0, 0]).pace is None
    scalars = dataclasses.replace(PACED.scalars, pace_floor=0.5)
    found = []
    for one in (program, probes.window_program("heuristic")):
        state = probes.start(one, [0, 1], [0, 0])
        _, state, metrics = one.train(probes.Window(), scalars, SCHEDULE, loop.start_clock(), state, STRETCH)
        assert ("guided_share" in metrics) == (one is program)
        metrics.pop("guided_share", None)
        found.append((probes.lane(state.replace(pace=None), 1), probes.lane(metrics, 1)))
    jax.tree.map(np.testing.assert_array_equal, *found)
