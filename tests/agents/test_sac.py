"""Soft actor-critic: its density, its targets, its critics and its temperature, against numbers from elsewhere."""

import dataclasses
import math
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from walk_task import BOX, SMALL, Walk

from cuelearner_jax.agents import sac
from cuelearner_jax.agents.categorical import BINS, ROOM, next_unit, project
from cuelearner_jax.agents.networks import next_moments
from cuelearner_jax.agents.replay import Memory, Transition, buffer_for, count_guided, stored_step
from cuelearner_jax.config import static
from cuelearner_jax.environment import Spaces, spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import DIRECTIONS, Choices

ENV, KEY = Walk(), jax.random.key(0)
SPACES = spaces_of(ENV)
BINNED = dataclasses.replace(SMALL, bins=True)
THREE = dataclasses.replace(SMALL, critics=3, target_critics=2)


def agent_of(options=SMALL, bootstraps=True):
    return options.make("raw", SPACES, bootstraps)


# The squashed Gaussian.


def test_the_density_integrates_to_one_and_draws_follow_it():
    mean, std = 0.7, 0.3
    unit = np.linspace(-1, 1, 200_002)[1:-1]
    before = np.arctanh(unit)
    noise, log_std = (before - mean) / std, np.full(len(unit), math.log(std))
    columns = (jnp.asarray(values, jnp.float32)[:, None] for values in (noise, log_std, before))
    density = np.exp(np.asarray(sac.squashed_log_density(*columns)).astype(float))
    assert np.trapezoid(density, unit) == pytest.approx(1, abs=2e-3)
    agent = agent_of()
    actor = jax.tree.map(jnp.zeros_like, agent.init(KEY)[0]["actor"])
    actor["params"]["Dense_1"]["bias"] = jnp.array([mean, mean, math.log(std), math.log(std)])
    drawn = agent.draw(actor, jnp.zeros((20_000, 2)), KEY)
    for moment in (1, 2):
        expected = np.trapezoid(unit**moment * density, unit)
        np.testing.assert_allclose(np.mean(np.asarray(drawn.unit) ** moment, 0), expected, atol=0.02)
    entropy = -np.trapezoid(density * np.log(density), unit)  # two independent entries have twice that
    assert float(-drawn.log_density.mean()) == pytest.approx(2 * entropy, abs=0.03)


def test_the_density_is_finite_where_tanh_is_one():
    log_p = sac.squashed_log_density(jnp.zeros((1, 2)), jnp.zeros((1, 2)), jnp.array([[60.0, -60.0]]))
    # log(1 - tanh(u)^2) is log 4 - 2 |u| far out.
    assert float(log_p[0]) == pytest.approx(2 * (120 - math.log(4) - 0.5 * math.log(2 * math.pi)), rel=1e-5)


def test_actions_lie_in_the_box_and_their_unit_coordinates_between_its_bounds():
    agent = agent_of()
    corners = jnp.array([BOX.low, BOX.high, (1.0, 0.25)])
    np.testing.assert_allclose(agent.in_unit(corners), [[-1, -1], [1, 1], [0, 0]], atol=1e-6)
    np.testing.assert_allclose(agent.in_box(agent.in_unit(corners)), corners, atol=1e-6)
    params, _ = agent.init(KEY)
    obs = jax.random.normal(KEY, (200, 2)) * 5
    best, tried = agent.act(None, params, obs, KEY), agent.explore(None, SMALL, params, obs, KEY)
    for actions in (best, tried):
        assert (np.asarray(actions) >= np.array(BOX.low)).all()
        assert (np.asarray(actions) <= np.array(BOX.high)).all()
    np.testing.assert_array_equal(best, agent.act(None, params, obs, jax.random.key(1)))
    assert np.abs(np.asarray(best - tried)).max() > 0.1


# Critics and targets.


def by_hand(critics, number, obs, unit):
    """A critic's value by NumPy."""
    dense = critics["params"]
    hidden = np.concatenate([obs, unit], -1) @ np.asarray(dense["Dense_0"]["kernel"][number])
    hidden = np.maximum(hidden + np.asarray(dense["Dense_0"]["bias"][number]), 0)
    values = hidden @ np.asarray(dense["Dense_1"]["kernel"][number]) + np.asarray(dense["Dense_1"]["bias"][number])
    return values[:, 0]


def batch_of(size=6):
    keys = jax.random.split(KEY, 4)
    discount = jnp.array([1.0, 0.0] * (size // 2))
    reward = jax.random.normal(keys[2], (size,))
    obs, next_obs = (jax.random.normal(key, (size, 2)) for key in keys[:2])
    return Transition(obs, BOX.sample(keys[3], (size,)), reward, discount, next_obs)


@pytest.mark.parametrize("entropy", [True, False])
def test_targets_are_those_counted_by_hand(entropy):
    agent = agent_of(dataclasses.replace(SMALL, entropy_in_targets=entropy))
    params, rest = agent.init(KEY)
    batch, temperature = batch_of(), 0.3
    found = agent.targets(0.9, params["actor"], rest.target_critics, temperature, batch, KEY)
    drawn = agent.draw(params["actor"], batch.next_obs, jax.random.split(KEY)[0])
    smallest = np.minimum(*(by_hand(rest.target_critics, n, batch.next_obs, drawn.unit) for n in range(2)))
    value = smallest - (temperature * np.asarray(drawn.log_density) if entropy else 0)
    np.testing.assert_allclose(found, batch.reward + 0.9 * batch.discount * value, rtol=1e-5, atol=1e-6)
    # Nothing follows a termination.
    np.testing.assert_array_equal(found[1::2], batch.reward[1::2])


def test_each_target_draws_a_subset_of_the_critics():
    agent = agent_of(dataclasses.replace(THREE, target_critics=1, entropy_in_targets=False))
    params, rest = agent.init(KEY)
    batch, seen = batch_of(), set()
    targets = jax.jit(lambda key: agent.targets(1.0, params["actor"], rest.target_critics, 0.0, batch, key))
    for number in range(10):
        key = jax.random.key(number)
        found = targets(key)
        unit = agent.draw(params["actor"], batch.next_obs, jax.random.split(key)[0]).unit
        each = [batch.reward + batch.discount * by_hand(rest.target_critics, n, batch.next_obs, unit) for n in range(3)]
        (own,) = [n for n in range(3) if np.allclose(found, each[n], rtol=1e-5, atol=1e-6)]
        seen.add(own)
    assert seen == {0, 1, 2}


def test_normalised_layers_bound_a_critics_value_of_any_action():
    agent = agent_of(dataclasses.replace(SMALL, layer_norm=True))
    critics = agent.init(KEY)[0]["critics"]
    near, far = (np.abs(agent.values(critics, jnp.ones(2), scale * jnp.ones((1, 2)))) for scale in (10, 1e4))
    np.testing.assert_allclose(far, near, rtol=0.2)
    plain = agent_of().init(KEY)[0]["critics"]
    assert np.abs(agent_of().values(plain, jnp.ones(2), 1e4 * jnp.ones((1, 2)))).max() > 1e3


# Learning.


GUIDED = np.arange(16) % 5 == 0  # steps 0, 5, 10, 15


@cache
def memory(factor=1.0, shift=0.0):
    """The first steps of sixteen walks, whose actions are their numbers; observations in other units, if given."""
    buffer, keys = buffer_for(ENV, True), jax.random.split(KEY, 16)
    state, obs = jax.vmap(ENV.reset)(keys)
    _, step = jax.vmap(ENV.step)(keys, state, BOX.sample(KEY, (16,)))
    numbers = jnp.arange(16.0)[:, None].repeat(2, 1)
    step = step.replace(aftermath=step.aftermath * factor + shift)
    stored = jax.vmap(partial(stored_step, bootstraps=True))(obs * factor + shift, numbers, step)
    counts = count_guided(jnp.zeros((96, 1), jnp.int32), jnp.array(0), jnp.asarray(GUIDED))
    return Memory(ENV, buffer, buffer.add(buffer.empty(96), jnp.array(0), stored), jnp.array(16), 16, True, counts)


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (0.25, 2), (0.5, 4), (1.0, 8)])
def test_a_minibatch_has_its_share_of_guided_steps(share, count):
    for number in range(4):
        (batch,) = memory().batches(jax.random.key(number), 8, guided_share=jnp.float32(share))
        drawn = np.asarray(batch.action)[:, 0].astype(int)
        assert [n % 5 == 0 for n in drawn] == [True] * count + [False] * (8 - count)


@cache
def update_of(still):
    """The compiled update of options without their floats."""
    kept = memory()
    return jax.jit(
        lambda options, scalars, params, rest: agent_of(still).update(
            ENV, options, scalars, jnp.array(1), params, rest, kept, KEY
        )
    )


def updated(options):
    """Parameters and the rest before an update, and what it returns."""
    before = agent_of(options).init(KEY)
    return before, update_of(static(options))(options, dataclasses.replace(probes.SCALARS, discount=0.9), *before)


def steps_of(opt_state):
    """How often Adam has stepped."""
    return int(next(leaf for leaf in jax.tree.leaves(opt_state) if leaf.dtype == jnp.int32))


def test_critics_step_for_each_minibatch_actor_and_temperature_once():
    (params, _), (after, state, loss, norm) = updated(dataclasses.replace(THREE, updates_per_step=3))
    assert [steps_of(opt) for opt in (state.critics_opt, state.actor_opt, state.temperature_opt)] == [3, 1, 1]
    for old, new in zip(jax.tree.leaves(params), jax.tree.leaves(after), strict=True):
        assert (old != new).any()
    assert float(loss) > 0
    assert np.isfinite(float(norm))
    # Target critics lag behind.
    lag = jax.tree.map(lambda new, target: float(jnp.abs(new - target).max()), after["critics"], state.target_critics)
    assert min(jax.tree.leaves(lag)) > 0


def test_target_critics_follow_at_their_rate():
    _, (after, state, *_) = updated(dataclasses.replace(SMALL, polyak=1.0))
    jax.tree.map(np.testing.assert_array_equal, state.target_critics, after["critics"])
    (_, rest), (_, state, *_) = updated(dataclasses.replace(SMALL, polyak=0.0))
    jax.tree.map(np.testing.assert_array_equal, state.target_critics, rest.target_critics)


@pytest.mark.parametrize(("entropy", "way"), [(5.0, 1), (-50.0, -1)])
def test_the_temperature_moves_the_entropy_to_its_target(entropy, way):
    _, (_, state, *_) = updated(dataclasses.replace(SMALL, target_entropy=entropy))
    assert np.sign(float(state.log_temperature)) == way
    _, (_, state, *_) = updated(dataclasses.replace(SMALL, target_entropy=entropy, temperature_rate=0.0))
    assert float(state.log_temperature) == 0


def test_at_discount_zero_targets_are_rewards():
    agent = agent_of(bootstraps=False)
    params, rest = agent.init(KEY)
    assert rest.target_critics is None
    batch = batch_of()
    found = agent.targets(0.0, params["actor"], None, 1.0, batch.replace(next_obs=jnp.zeros((6, 0))), KEY)
    np.testing.assert_array_equal(found, batch.reward)


class Dark(Walk):
    """The walk, of which actors see the time alone and critics the place as well."""

    observation, privileged = Walk.observation[1:], 1

    def reset(self, key):
        state, _ = super().reset(key)
        return state, state[1:]

    def step(self, key, state, action):
        after, step = super().step(key, state, action)
        return after, step.replace(obs=after[1:], final_obs=step.final_obs[1:], aftermath=step.final_obs[::-1])

    def remember(self, state, obs):
        return state[::-1]

    def recall(self, memory):
        return memory[:1]

    def recall_next(self, memory, action, aftermath):
        return aftermath[:1]


def test_critics_alone_see_what_is_privileged():
    env = Dark()
    buffer, (state, obs) = buffer_for(env, True), jax.vmap(env.reset)(jax.random.split(KEY, 16))
    _, step = jax.vmap(env.step)(jax.random.split(KEY, 16), state, BOX.sample(KEY, (16,)))
    memories = jax.vmap(env.remember)(state, obs)
    stored = jax.vmap(partial(stored_step, bootstraps=True))(memories, BOX.sample(KEY, (16,)), step)
    of = Memory(env, buffer, buffer.add(buffer.empty(96), jnp.array(0), stored), jnp.array(16), 16, True)
    batch, later = of.batches(KEY, 8, 2, 0.9)
    jax.tree.map(np.testing.assert_array_equal, batch, later)  # no second step was taken
    assert (batch.obs.shape, batch.next_obs.shape) == ((8, 1), (8, 1))
    np.testing.assert_allclose(batch.reward, -jnp.abs(batch.privileged[1][:, 0]))  # the walk pays for its next place

    agent = dataclasses.replace(SMALL, normalise_obs=True).make("raw", spaces_of(env), True)
    before, scalars = agent.init(KEY), dataclasses.replace(probes.SCALARS, discount=0.9)
    params, *_ = agent.update(env, agent.options, scalars, jnp.array(1), *before, of, KEY)
    assert params["obs"]["mean"][1] != 0  # the place, beside the time, which is 0 in first steps
    inputs = {name: params[name]["params"]["Dense_0"]["kernel"].shape[-2] for name in ("actor", "critics")}
    assert inputs == {"actor": 1, "critics": 2 + BOX.size}
    assert agent.act(env, params, obs, KEY).shape == (16, 2)


# Normalised observations.


def test_moments_of_the_first_batches_are_those_of_all_rows():
    batches = 5000 + np.random.default_rng(0).normal(size=(3, 8, 2)).astype(np.float32)
    moments = {"mean": jnp.zeros(2), "variance": jnp.ones(2)}
    for count, batch in enumerate(batches, 1):
        moments = next_moments(moments, jnp.asarray(batch), jnp.array(count))
    rows = batches.reshape(-1, 2).astype(float)
    np.testing.assert_allclose(moments["mean"], rows.mean(0), rtol=1e-6)
    np.testing.assert_allclose(moments["variance"], rows.var(0), rtol=1e-2)


def test_with_normalised_observations_an_agent_learns_and_acts_alike_in_any_units():
    agent, obs = agent_of(dataclasses.replace(SMALL, normalise_obs=True)), jax.random.normal(KEY, (5, 2))
    before, scalars = agent.init(KEY), dataclasses.replace(probes.SCALARS, discount=0.9)
    update = lambda of: agent.update(ENV, agent.options, scalars, jnp.array(1), *before, of, KEY)[0]  # noqa: E731
    plain, odd = (jax.jit(partial(update, memory(*units)))() for units in ((), (1e3, 7.0)))
    expected = agent.act(None, plain, obs, KEY)
    np.testing.assert_allclose(agent.act(None, odd, obs * 1e3 + 7, KEY), expected, atol=1e-3)
    assert np.abs(expected - agent.act(None, plain, obs * 1e3 + 7, KEY)).max() > 0.01


# Critics over bins of value.


def test_a_value_goes_to_its_two_nearest_bins():
    result = np.asarray(project(jnp.array([[0.25, 7.0]]), jnp.array([[0.4, 0.6]])))[0]
    # 0.25 lies between bins 52 and 53 of width 0.1 from -5 on; 7 is beyond the last.
    np.testing.assert_allclose(result[[52, 53, 100]], [0.2, 0.2, 0.6], atol=1e-5)
    assert result.sum() == pytest.approx(1, abs=1e-6)


def test_the_unit_is_a_running_root_mean_square_of_rewards_by_their_horizon():
    rewards = jnp.array([3.0, -4.0])
    first = next_unit(jnp.float32(1), rewards, 0.9, jnp.array(1))
    assert float(first) == pytest.approx(np.sqrt(12.5) / 0.1 / ROOM, rel=1e-5)
    later = next_unit(first, 0 * rewards, 0.9, jnp.array(10_000))
    assert float(later / first) == pytest.approx(np.sqrt(1 - 1e-3), rel=1e-5)


@pytest.mark.parametrize("discount", [0.0, 0.9])
def test_distributions_to_learn_are_those_counted_by_hand(discount):
    """New critics predict the same everywhere; a bin's bias falls by the prediction less the targets' mean there."""
    agent, batch, temperature = BINNED.make("raw", SPACES, discount > 0), batch_of(), 0.3
    params, rest = agent.init(KEY)
    behind = discount, params["actor"], rest.target_critics, temperature, batch, KEY
    error = agent._binned_error(*behind, params["critics"], jnp.array(1))
    (loss, _), gradient = jax.value_and_grad(error, has_aux=True)(params["critics"])
    weights = (1 + (BINS / 0.2) ** 2) ** -2
    first = weights / weights.sum()
    result = first - 2 * np.asarray(gradient["params"]["bins"]["bias"][0])  # the loss is the mean of two critics
    unit = float(next_unit(jnp.float32(1), batch.reward, discount, jnp.array(1)))
    drawn = agent.draw(params["actor"], batch.next_obs, jax.random.split(KEY)[0])
    next_values = BINS - temperature * np.asarray(drawn.log_density)[:, None]
    values = np.asarray(batch.reward)[:, None] + discount * np.asarray(batch.discount)[:, None] * next_values
    expected = np.zeros(BINS.size)
    for value, weight in zip(np.clip(values / unit, -5, 5).ravel(), np.tile(first, len(values)), strict=True):
        expected += weight / len(values) * np.clip(1 - np.abs((value + 5) / 0.1 - np.arange(BINS.size)), 0, 1)
    np.testing.assert_allclose(result, expected, atol=1e-4)
    assert float(loss) == pytest.approx(-expected @ np.log(first), rel=1e-4)


def test_targets_are_normalised_by_their_batch_alone():
    agent, batch, one = BINNED.make("raw", SPACES, True), batch_of(), jnp.array(1)
    params, rest = agent.init(KEY)
    own, target = params["critics"], jax.tree.map(lambda leaf: leaf + 0.1, rest.target_critics)

    def loss(critics):
        return agent._binned_error(0.9, params["actor"], critics, 0.3, batch, KEY, own, one)(own)[0]

    assert loss(target) == loss({**target, "batch_stats": own["batch_stats"]}) != loss(rest.target_critics)


def test_an_update_keeps_weights_at_length_one_and_counts_the_batch():
    (before, _), (after, *_) = updated(BINNED)
    for critics in (before["critics"], after["critics"]):
        np.testing.assert_allclose(np.linalg.norm(critics["params"]["Dense_0"]["kernel"], axis=-2), 1, rtol=1e-5)
    for name in ("batch_stats", "unit"):
        old, new = (jax.tree.leaves(critics[name]) for critics in (before["critics"], after["critics"]))
        assert all((one != other).any() for one, other in zip(old, new, strict=True))


# What is refused.


@pytest.mark.parametrize("space", [DIRECTIONS, Choices(3)], ids=["directions", "choices"])
def test_other_spaces_are_refused_with_the_agent_that_serves_them(space):
    with pytest.raises(UserError, match=f"'sac' acts in boxes, not in {space.name}: give --agent ddqn") as told:
        SMALL.make("raw", Spaces(2, space))
    assert "\n" not in str(told.value)
