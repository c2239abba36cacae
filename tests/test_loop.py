"""The training loop on probes: values known by hand, who acts when, and what lanes owe each other (nothing)."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import probes
import pytest

from cuelearner_jax import evaluate, loop
from cuelearner_jax.agents.networks import as_function, q_network
from cuelearner_jax.arbiters import Episodes
from cuelearner_jax.devices import lane_mesh
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Agent
from cuelearner_jax.spaces import directions
from cuelearner_jax.types import Step

ENV, EXPERT = probes.Window(), probes.Expert(probes.Window())
MESH = lane_mesh()
q = as_function(q_network(probes.AGENT.q_layers))
LARGEST = probes.LARGEST
STRETCH = 12  # iterations of one call, always the same: another number compiles again


def replaced(probability=0.5, learning_rate=probes.AGENT.learning_rate, **schedule):
    """The settings of `probes.CONFIG` with others."""
    return probes.SETTINGS._replace(
        schedule=dataclasses.replace(probes.SCHEDULE, **schedule),
        arbiter=Episodes(probability),
        agent=dataclasses.replace(probes.AGENT, learning_rate=learning_rate),
    )


def run(program, settings, clock, state, stretches=1):
    """Trains for some stretches; the metrics of the last one."""
    metrics = {}
    for _ in range(stretches):
        clock, state, metrics = program.train(ENV, settings, clock, state, STRETCH)
    return clock, state, metrics


# Learning values that are known.


def test_the_agent_learns_a_bandit_by_itself():
    program = probes.window_program("none")
    state = probes.start(program, [0], [0])
    before = reward_of(state.agent.params)
    settings = replaced(random_steps=400, learn_after=32)
    _, state, metrics = run(program, settings, loop.start_clock(), state, stretches=34)
    assert reward_of(state.agent.params)[0] == 1.0
    assert before[0] < 0.8
    assert metrics["loss"].shape == (1,)
    # The value of a direction is its chance to win: 1 inside the window and 0 outside.
    obs = directions.evenly_spaced(4)
    inside = jax.vmap(lambda obs: q(probes.lane(state.agent.params, 0), obs, ENV.best(obs))[0])(obs)
    outside = jax.vmap(lambda obs: q(probes.lane(state.agent.params, 0), obs, -ENV.best(obs))[0])(obs)
    np.testing.assert_allclose(inside, 1, atol=0.15)
    np.testing.assert_allclose(outside, 0, atol=0.15)


def reward_of(params):
    measured = evaluate.rollout_lanes(ENV, Agent(params, probes.FUNCTIONS), jax.random.key(7), 40, 80, mesh=MESH).means
    np.testing.assert_array_equal(measured["reward"], measured["hit"])
    return np.asarray(measured["reward"])


CHAIN = probes.CHAIN
chain_program = cache(partial(probes.chain_program, CHAIN, "heuristic"))
chain_values = cache(lambda truncates: probes.chain_values(chain_program(), CHAIN, truncates))


@pytest.mark.parametrize("truncates", [False, True])
def test_values_of_a_chain(truncates):
    # Terminated: Q(1, a) = a_x; Q(0, a) = a_y / 2 + 0.5 * 1. Truncated, place 1 goes on as if it had no end:
    # Q(1, a) = a_x + 0.5 / (1 - 0.5); Q(0, a) = a_y / 2 + 0.5 * 2. With the observation after the reset in its place,
    # the largest value at 1 would be 5 / 3 and not 2.
    (start, end), _ = chain_values(truncates)
    near = 0.1 if truncates else 0.06
    np.testing.assert_allclose(end, np.array([1, 0, -1, 0]) + truncates, atol=near)
    np.testing.assert_allclose(start, np.array([0.5, 1.0, 0.5, 0.0]) + 0.5 * truncates, atol=near)


def test_replay_keeps_what_each_step_led_to():
    _, state = chain_values(truncates=False)
    terminated = probes.stored(state, 0, 2000)
    _, state = chain_values(truncates=True)
    truncated = probes.stored(state, 0, 2000)
    at_end = np.repeat(np.tile([False, True], 500), 2)  # two environments in step with each other
    np.testing.assert_array_equal(terminated["obs"][:, 1] == 1, at_end)
    np.testing.assert_array_equal(terminated["discount"], np.where(at_end, 0, 1))
    np.testing.assert_array_equal(truncated["discount"], 1)
    np.testing.assert_array_equal(truncated["next_obs"], np.tile([0.0, 1.0], (2000, 1)))  # never after the reset
    expected = np.where(at_end, terminated["action"][:, 0], 0.5 * terminated["action"][:, 1])
    np.testing.assert_allclose(terminated["reward"], expected, atol=1e-6)


# Who acts when.


def acted(kind, probability=0.5, stretches=1, **schedule):
    """What one lane's environments met and did, and its parameters; nothing is learned."""
    program = probes.window_program(kind)
    state = probes.start(program, [0], [0])
    settings = replaced(probability, learn_after=10**9, **schedule)
    clock, state, _ = run(program, settings, loop.start_clock(), state, stretches)
    assert int(clock.step) == 48 * stretches
    assert int(clock.update) == 0
    return probes.stored(state, 0, 48 * stretches), probes.lane(state.agent.params, 0)


def test_first_uniform_then_guided_then_greedy():
    met, params = acted("heuristic", probability=1.0)
    greedy = probes.greedy_actions(q, params, met["obs"])
    turned = np.asarray(ENV.heuristic(met["obs"]))
    options = np.asarray(directions.evenly_spaced(probes.AGENT.directions))
    among = np.abs(met["action"][:, None] - options).max(-1).min(-1)
    assert among[:8].min() > 1e-4  # a uniform direction is none of the sixteen
    np.testing.assert_allclose(met["action"][8:24], turned[8:24], atol=1e-6)
    np.testing.assert_array_equal(met["action"][24:], greedy[24:])
    assert np.abs(turned - greedy).max(-1).min() > 1e-3  # so the three can be told apart


@pytest.mark.parametrize(("kind", "probability"), [("heuristic", 0.0), ("none", 1.0)])
def test_actions_that_nothing_guides_are_greedy_after_the_random_steps(kind, probability):
    met, params = acted(kind, probability)
    np.testing.assert_array_equal(met["action"][8:], probes.greedy_actions(q, params, met["obs"])[8:])


def test_an_episode_is_guided_as_a_whole():
    env = probes.Chain(jnp.array(False))
    state = probes.start(chain_program(), [0], [0], env)
    schedule = dataclasses.replace(CHAIN.schedule, random_steps=2, learn_after=10**9, guidance_until=2000)
    settings = CHAIN.settings._replace(schedule=schedule)
    _, state, _ = chain_program().train(env, settings, loop.start_clock(), state, 1000)
    turned = np.abs(probes.stored(state, 0, 2000)["action"] - np.asarray(env.heuristic(None))).max(-1) < 1e-6
    by_episode = turned.reshape(-1, 2, 2)[1:]  # (episodes, its two steps, environments)
    np.testing.assert_array_equal(by_episode[:, 0], by_episode[:, 1])
    assert by_episode.mean() == pytest.approx(0.5, abs=0.08)


@pytest.mark.parametrize(("learn_after", "steps", "updates"), [(49, 0, 0), (48, 0, 4), (44, 0, 8), (44, 2, 4)])
def test_learning_begins_after_learn_after(learn_after, steps, updates):
    """As many updates as environments, or as are asked for, from the iteration that reaches the step."""
    config = dataclasses.replace(probes.CONFIG, sizes=dataclasses.replace(probes.SIZES, gradient_steps=steps))
    program = probes.make_program(config, guidances.make("none", config.sizes, ENV), ENV, 0)
    state = probes.start(program, [0], [0])
    before = probes.lane(state.agent.params, 0)
    clock, state, _ = run(program, replaced(learn_after=learn_after), loop.start_clock(), state)
    assert int(clock.update) == optax.tree.get(state.agent.training, "count")[0] == updates
    changed = jax.tree.map(lambda one, other: (one != other).any(), before, probes.lane(state.agent.params, 0))
    assert set(jax.tree.leaves(changed)) == {updates > 0}


# Lanes.

BUDGETS = [15, 15, LARGEST, LARGEST]
SEEDS = [1, 2, 1, 2]


def labelled(program, seeds, budgets, rounds=LARGEST // 10, scalars=probes.SCALARS):
    clock, state = loop.start_clock(), probes.start(program, seeds, budgets)
    for _ in range(rounds):
        clock, state = program.label_round(ENV, EXPERT, scalars, clock, state)
    return clock, state


def assert_equal(one, other):
    for mine, yours in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(mine, yours)


def trained(program, seeds, budgets):
    """Labels, then training through random, guided and greedy steps with gradient steps."""
    clock, state = labelled(program, seeds, budgets, -(-max(budgets) // 10))
    _, state, metrics = run(program, probes.SETTINGS, clock, state)
    return state, metrics


@pytest.fixture(scope="module")
def grid():
    return trained(probes.window_program("relative"), SEEDS, BUDGETS)


def test_a_lane_is_the_same_beside_any_others(grid):
    state, metrics = grid
    beside, measured = trained(probes.window_program("relative"), [5, 6, 7, SEEDS[3]], BUDGETS)
    assert not np.array_equal(beside.agent.replay[0], state.agent.replay[0])
    assert_equal(probes.lane(state, 3), probes.lane(beside, 3))  # to the last bit
    assert_equal(probes.lane(metrics, 3), probes.lane(measured, 3))


# Lanes that are no longer finite.


def test_a_lane_that_diverges_stays_at_its_last_finite_state_and_touches_no_other():
    program = probes.window_program("relative")
    clock, state = labelled(program, SEEDS, BUDGETS, 1)
    wrong = jnp.array([1.0, 1e30, 1.0, 1.0])  # squared it is beyond float32: so are the loss and the gradient's norm
    before = jax.tree.map(jnp.copy, state.agent.params)
    poisoned = jax.tree.map(lambda leaf: leaf * wrong.reshape(4, *[1] * (leaf.ndim - 1)), before)
    sick = jax.tree.map(jnp.copy, state.replace(agent=state.agent.replace(params=poisoned)))
    _, healthy, _ = run(program, probes.SETTINGS, clock, state, stretches=2)
    _, after, metrics = run(program, probes.SETTINGS, clock, sick, stretches=2)
    assert not healthy.failed.any()
    np.testing.assert_array_equal(after.failed, wrong > 1)
    np.testing.assert_array_equal(np.isfinite(metrics["loss"]), wrong == 1)
    assert_equal(probes.lane(after.agent.params, 1), probes.lane(poisoned, 1))
    for other in (0, 2, 3):
        assert_equal(probes.lane(after, other), probes.lane(healthy, other))


def test_a_step_beyond_all_numbers_is_taken_back():
    program = probes.window_program("none")
    state = probes.start(program, [0], [0])
    fresh = jax.tree.map(jnp.copy, state.agent)
    # In the last iteration alone: nothing looks at its parameters after that.
    _, state, _ = run(program, replaced(learning_rate=3e38, learn_after=48), loop.start_clock(), state)
    assert state.failed.all()
    assert_equal(state.agent.params, fresh.params)
    assert_equal(state.agent.training, fresh.training)


def test_a_fit_that_diverges_fails_the_lane_and_leaves_its_guide():
    program = probes.window_program("relative")
    clock, state = labelled(program, SEEDS, BUDGETS, 1)
    guide = jax.tree.map(lambda leaf: np.asarray(probes.words(leaf)), state.guide)
    assert not state.failed.any()
    wild = dataclasses.replace(probes.SCALARS, feedback_learning_rate=1e30)
    clock, state = program.label_round(ENV, EXPERT, wild, clock, state)
    assert state.failed.all()
    assert_equal(jax.tree.map(lambda leaf: np.asarray(probes.words(leaf)), state.guide), guide)
    _, state = program.label_round(ENV, EXPERT, probes.SCALARS, clock, state)  # once failed, always
    assert state.failed.all()
    assert_equal(jax.tree.map(lambda leaf: np.asarray(probes.words(leaf)), state.guide), guide)


# Environments that are no program of JAX.


class PlainWindow:
    """The bandit in NumPy, its contexts drawn beforehand: (steps, num_envs, 2)."""

    def __init__(self, contexts):
        self.contexts, self.now, self.seen = contexts, contexts[0], []

    def step(self, actions):
        """Returns what the actions led to, as `types.Step` has it, of every environment."""
        best = [complex(*obs) * np.exp(0.6j) for obs in self.now]
        error = [abs(np.angle(complex(*action) / goal)) for action, goal in zip(actions, best, strict=True)]
        reward = np.array(np.array(error) <= 0.5, np.float32)
        self.seen.append(self.now)
        final, self.now = self.now, self.contexts[len(self.seen)]
        ended = np.ones(len(reward), bool)
        return Step(self.now, final, final, reward, ended, ~ended, {"hit": reward}, {})


def test_a_plain_environment_between_acting_and_learning_gives_the_compiled_loop():
    program, guide = probes.window_program("heuristic"), guidances.make("heuristic", probes.SIZES, ENV)
    lane, settings = loop.lane_of(probes.SIZES, loop.parts_of(probes.CONFIG), guide, 0, ENV), replaced()
    _, compiled, _ = run(program, settings, loop.start_clock(), probes.start(program, [3], [0]))
    clock, state = loop.start_clock(), lane.init(ENV, jax.random.fold_in(jax.random.key(0), 3), 0)

    def drawn(step):  # the contexts that the environment of JAX draws
        return jax.vmap(ENV.reset)(jax.random.split(lane.keys(clock.replace(step=step), state).step, 4))[1]

    contexts = np.concatenate([np.asarray(state.agent.obs)[None], jax.jit(jax.vmap(drawn))(4 * jnp.arange(STRETCH))])
    act, absorb, learn = jax.jit(lane.act), jax.jit(lane.absorb), jax.jit(lane.learn)
    plain = PlainWindow(contexts)
    for _ in range(STRETCH):
        keys = lane.keys(clock, state)
        acted = act(ENV, settings, clock, state, keys.act)
        state, _ = absorb(settings, clock, state, keys.absorb, acted, plain.step(np.asarray(acted.actions)))
        state, _ = learn(ENV, settings, clock, state, keys.learn)
        clock = lane.advance(clock, settings.schedule)
    compiled, own = probes.lane(compiled, 0), jax.tree.map(lambda leaf: np.asarray(probes.words(leaf)), state)
    assert own.agent.replay[:48, 4].any()  # rewards
    drop = lambda found: found.replace(agent=found.agent.replace(env=None))  # noqa: E731  # the world keeps its state
    assert_equal(drop(own), drop(compiled))  # to the last bit


# Compiling once.


def test_other_scalars_schedules_worlds_and_times_compile_nothing(grid):
    program = probes.window_program("relative")
    compilations = lambda: [part._cache_size() for part in (program.init, program.label_round, program.train)]  # noqa: E731
    before = compilations()
    clock, state = loop.start_clock(), probes.start(program, [7, 8, 9, 10], [1, 11, 33, LARGEST])
    for index in range(3):
        env = probes.Window(0.1 * index, 0.2 * index)
        scalars = dataclasses.replace(probes.SCALARS, eps_deg=5.0 + index, k_max=10 + index)
        other = {"learning_rate": 0.01 * index, "random_steps": index, "learn_after": 4 * index}
        settings = replaced(0.2, guidance_until=20 + index, **other)._replace(scalars=scalars)
        settings = settings._replace(agent=dataclasses.replace(settings.agent, target_every=1 + index))
        clock, state = program.label_round(env, probes.Expert(env), scalars, clock, state)
        clock, state, _ = program.train(env, settings, clock, state, STRETCH)
    assert compilations() == before
