"""Labels as a prior: what is chosen by hand-computed sums, which arm plays when, and which one acts in the end."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from cuelearner_jax import evaluate, loop
from cuelearner_jax.arbiters import prior
from cuelearner_jax.arbiters.protocol import Chooses, Finishes, LaneParts, Outcome
from cuelearner_jax.environment import spaces_of
from cuelearner_jax.guides import registry
from cuelearner_jax.guides.base import Candidates
from cuelearner_jax.policies import Agent, describe
from cuelearner_jax.policies.final import final_policy
from cuelearner_jax.runs import judging
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.runs.program import make_program
from cuelearner_jax.runs.training import Training
from cuelearner_jax.spaces import DIRECTIONS, directions

ENV, OBS = probes.Aimed(), directions.evenly_spaced(4)
OPTIONS = prior.Config(beta=0.1, trust_after=1000.0, near_deg=2.0, near_actions=9, directions=36, judge_steps=100)
ARBITER = OPTIONS.make(False)
KEY = jax.random.key(0)


class Valued:
    """An agent that values three actions, and does a fourth by itself."""

    def value(self, env, params, obs, actions):
        near = DIRECTIONS.distance(actions[:, None], ENV.aims(obs).actions[None, :3]) < 0.1
        return jnp.where(near.any(-1), params[jnp.argmax(near, -1)], 5.0)

    def act(self, env, params, obs, key):
        return -obs


class Knowing(type(registry.make("any_aim", probes.SIZES, ENV))):
    """A guide that says what its model says of the three aims."""

    def log_p(self, model, env, obs, actions, scalars):
        near = DIRECTIONS.distance(actions[:, None], ENV.aims(obs).actions[None, :3]) < 0.1
        return model[jnp.argmax(near, -1)]


GUIDE = Knowing(registry.find("any_aim"), probes.SIZES, spaces_of(ENV))
VALUES, LOG_P = jnp.array([0.0, 0.3, 0.0]), jnp.array([0.0, -2.0, -9.0])


def known(steps, guide=GUIDE):
    return LaneParts(ENV, Valued(), VALUES, guide, LOG_P, probes.SCALARS, jnp.float32(steps))


def chosen(arm, steps, options=OPTIONS, guide=GUIDE):
    """How far an arm's actions in four situations lie from the situation, and whether they are aims."""
    acted = ARBITER.act(jnp.asarray(arm), options, known(steps, guide), OBS, KEY)
    return np.asarray(directions.difference(OBS, acted))


@pytest.mark.parametrize(
    ("steps", "beta", "turn"),
    [
        (0, 0.1, -1.0),  # before the first step of learning log p alone counts
        (1000, 0.1, 0.6),  # 0.3 - 0.1 * 2 > 0: the second aim
        (1000, 0.2, -1.0),  # 0.3 - 0.2 * 2 < 0: the first
        (500, 0.1, -1.0),  # beta is twice as large after half of the steps
        (10**7, 0.2, 0.6),  # values alone in the end
        (1000, 0.0, 0.6),
    ],
)
def test_the_choice_is_the_largest_sum_of_value_and_prior(steps, beta, turn):
    options = dataclasses.replace(OPTIONS, beta=beta)
    np.testing.assert_allclose(chosen(prior.PRIOR, steps, options), turn, atol=1e-5)


def test_the_own_arm_is_the_agent_whatever_the_labels_say():
    np.testing.assert_allclose(np.abs(chosen(prior.OWN, 0)), math.pi, atol=1e-5)


def test_actions_near_the_choice_are_within_reach_and_the_best_of_them():
    class Slanted(Knowing):
        def log_p(self, model, env, obs, actions, scalars):
            turned = directions.difference(jnp.broadcast_to(obs, actions.shape), actions)
            return super().log_p(model, env, obs, actions, scalars) + turned

    slanted = Slanted(registry.find("any_aim"), probes.SIZES, spaces_of(ENV))
    found = chosen(prior.NEAR, 0, guide=slanted)
    np.testing.assert_allclose(found, -1.0 + math.radians(2.0), atol=1e-5)
    np.testing.assert_allclose(chosen(prior.NEAR, 0), -1.0, atol=1e-6)  # all near it alike: the aim itself


def test_without_a_candidate_the_agent_acts():
    class Aimless(Knowing):
        def candidates(self, env, obs):
            return Candidates(env.aims(obs).actions, jnp.zeros(4, bool))

    aimless = Aimless(registry.find("any_aim"), probes.SIZES, spaces_of(ENV))
    np.testing.assert_allclose(np.abs(chosen(prior.PRIOR, 0, guide=aimless)), math.pi, atol=1e-5)


def test_a_guide_without_candidates_chooses_among_all_directions():
    heuristic = registry.make("heuristic", probes.SIZES, ENV)
    of = known(0, heuristic)._replace(model=heuristic.init(KEY))
    found = np.asarray(directions.difference(OBS, ARBITER.act(jnp.asarray(prior.PRIOR), OPTIONS, of, OBS, KEY)))
    assert np.abs(found + 1.0).max() <= math.pi / 36 + 1e-5


def drawn_of(playing, learns, key=KEY):
    state = prior.Arms(jnp.asarray(playing), jnp.array(prior.PRIOR))
    obs = jnp.broadcast_to(OBS[:1], (len(playing), 2))
    base = directions.rotate(obs, jnp.asarray(3.0))
    refined = ARBITER.choose(state, OPTIONS, known(0), obs, base, jnp.array(learns), key)
    return np.asarray(directions.difference(obs, refined.actions)), np.asarray(refined.passes)


def test_in_the_random_steps_aims_are_drawn_from_the_prior():
    turns, passes = drawn_of([prior.PRIOR] * 4000, learns=False)
    share = np.exp(np.asarray(LOG_P)) / np.exp(np.asarray(LOG_P)).sum()
    found = [(np.abs(turns - turn) < 1e-5).mean() for turn in (-1.0, 0.6, 2.5)]
    assert sum(found) == 1.0
    np.testing.assert_allclose(found, share, atol=3 * math.sqrt(0.25 / 4000))
    assert (passes == 1).all()


def test_each_environment_acts_by_its_own_arm():
    turns, passes = drawn_of([prior.OWN, prior.PRIOR, prior.NEAR], learns=True)
    np.testing.assert_allclose(turns, [3.0, -1.0, -1.0], atol=1e-5)
    assert passes.tolist() == [0, 1, 1]
    near, _ = drawn_of([prior.NEAR] * 500, learns=False)
    off = np.degrees(np.abs(near[:, None] - np.array([-1.0, 0.6, 2.5])).min(-1))
    assert 1.5 < off.max() <= 2.001


def test_arms_are_drawn_by_their_shares_where_an_episode_ends():
    options = dataclasses.replace(OPTIONS, own_share=0.6, near_share=0.25)
    state = ARBITER.init(4000)
    done = jnp.arange(4000) < 3000
    after = ARBITER.follow(
        state, options, probes.SCALARS, Outcome(jnp.zeros(4000), done, jnp.array(False)), jax.random.key(3)
    )
    counts = np.bincount(np.asarray(after.playing)[:3000], minlength=3) / 3000
    np.testing.assert_allclose(counts, [0.6, 0.3, 0.1], atol=0.03)
    np.testing.assert_array_equal(after.playing[3000:], state.playing[3000:])


# In the loop, on the bandit: the rule's favourite is the best aim.

CONFIG = probes.config(
    arbiter=dataclasses.replace(OPTIONS, own_share=0.0, near_share=0.0), schedule={"guidance_until": 32}
)


def group_of(kind, config=CONFIG):
    guide = registry.make(kind, config.sizes, ENV)
    return LaneGroup(config, ENV, guide, Grid((kind,), (0, 1), (10,)))


def test_it_is_what_the_protocols_ask():
    assert isinstance(ARBITER, Chooses)
    assert isinstance(ARBITER, Finishes)


def test_a_lane_acts_among_the_aims_until_the_cut_off():
    program = make_program(CONFIG, registry.make("rule", CONFIG.sizes, ENV), ENV, 0)
    state = probes.start(program, [0, 1], [0, 0], ENV)
    _, state, metrics = program.train(ENV, CONFIG.settings, loop.start_clock(), state, 12)
    met = probes.stored(state, 0, 48)
    turns = np.array(directions.difference(jnp.asarray(met["obs"]), jnp.asarray(met["action"])))
    aimed = np.abs(turns[:, None] - np.array([-1.0, 0.6, 2.5])).min(-1)
    assert aimed[4:32].max() < 1e-4  # in the random steps too; the first episodes may also be near an aim
    assert aimed[:4].max() < math.radians(2.01)
    assert (aimed[32:] > 1e-3).mean() > 0.5
    assert float(metrics["guided_share"][0]) == pytest.approx(32 / 48)


@pytest.fixture(scope="module")
def trained():
    training = Training(group_of("rule"), ENV, "validation", judged=ENV)
    training.begin()
    return training, list(training.stretches())


def test_the_arm_that_validates_best_acts_and_says_so(trained):
    training, rows = trained
    assert [row["step"] for row in rows] == [0, 16, 32, 48]
    first = rows[0]
    np.testing.assert_array_equal(first["judged_prior"], 1.0)
    assert (first["judged_own"] < 1.0).all()
    assert (first["arm"] != prior.OWN).all()
    np.testing.assert_array_equal(first["reward"], 1.0)
    policies = training.policies(ENV)
    measured = evaluate.rollout_lanes(ENV, policies, evaluate.episodes(), 10, 20).means
    np.testing.assert_array_equal(measured["reward"], rows[-1]["reward"])
    described = describe(policies.lane(1))
    assert described["arm"] == prior.ARMS[int(rows[-1]["arm"][1])]
    assert described["steps_learned_from"] == 44.0
    assert described["arbiter"]["beta"] == pytest.approx(0.1)


def test_of_arms_that_validate_alike_the_agent_acts():
    training = Training(group_of("none", probes.config(arbiter=OPTIONS)), ENV, "validation", judged=ENV)
    training.begin()
    row = training.evaluation()
    # Without guidance the prior chooses by values among its own directions, which are not the agent's sixteen.
    best = np.argmax([row[f"judged_{arm}"] for arm in prior.ARMS], axis=0)
    np.testing.assert_array_equal(row["arm"], best)


def test_another_arbiter_leaves_the_agent_alone():
    group = group_of("rule", probes.CONFIG)
    lane = group.start()[0]
    policy = final_policy(
        probes.CONFIG, group.guidance, ENV, 0, {"params": lane.agent.params, "guidance": lane.guide.model}
    )
    assert isinstance(policy, Agent)
    assert judging.judges_world(probes.CONFIG, lambda split: pytest.fail("made")) is None


def test_a_judge_counts_discounted_returns_of_whole_episodes():
    """The chain pays half the action's y, then the action's x: toward north-east (0.707 / 2) + 0.5 * 0.707."""
    chain = judging.Returns(probes.Chain(jnp.array(False)), 0.5)
    north_east = probes.Acting(lambda key, states, obs: jnp.broadcast_to(jnp.sqrt(jnp.array([0.5, 0.5])), obs.shape))
    means = evaluate.rollout(north_east, chain, judging.judges_episodes(), 4, 24)
    assert float(means["ended"]) == 0.5
    assert float(judging.score(means, bootstraps=True)) == pytest.approx(math.sqrt(0.5), rel=1e-5)
    assert float(judging.score(means, bootstraps=False)) == pytest.approx(0.75 * math.sqrt(0.5), rel=1e-5)


def test_where_no_arm_ends_an_episode_the_reward_a_step_tells():
    ends = {"returned": np.array([0.0, 0.3]), "ended": np.array([0.0, 0.5]), "reward": np.array([-2.0, 1.0])}
    never = {"returned": np.zeros(2), "ended": np.zeros(2), "reward": np.array([-1.0, 2.0])}
    np.testing.assert_allclose(judging.scores([ends, never], bootstraps=True), [[-2.0, 0.6], [-1.0, 0.0]])
    np.testing.assert_allclose(judging.scores([ends, never], bootstraps=False), [[-2.0, 1.0], [-1.0, 2.0]])
