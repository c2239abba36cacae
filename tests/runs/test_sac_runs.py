"""Runs of guided soft actor-critics: lanes, resuming, the finished policy, its export."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import walk_task
from small_runs import stopping_at
from walk_task import SMALL, TASK, Walk, WalkConfig

from cuelearner_jax import loop
from cuelearner_jax.adaptation import serialization
from cuelearner_jax.arbiters import Episodes
from cuelearner_jax.evaluate import episodes, rollout_with_progress
from cuelearner_jax.export import contract, decisions
from cuelearner_jax.guides import registry
from cuelearner_jax.policies import Agent
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.policy_sources import LaneChoice, PolicySource
from cuelearner_jax.storage import results
from cuelearner_jax.studies import train
from cuelearner_jax.terminal import Interrupted

ENV = Walk()
SCHEDULE = {"total_steps": 48, "guidance_until": 48, "eval_every": 16, "checkpoint_every": 16, "learn_after": 8}
CONFIG = walk_task.config(
    dataclasses.replace(SMALL, replay_capacity=32),  # written over before the end
    Episodes(1.0),
    sizes={"lanes_per_block": 1},
    schedule=SCHEDULE,
)
GRID = Grid(("heuristic",), (0, 1), (0,))


def run(out, **options):
    train.run(Order(TASK, CONFIG, GRID, out, **options))


def rows(out):
    names = ("seed", "step", "reward", "train_loss", "train_guided_share")
    found = [{name: row[name] for name in names} for row in results.read(out).to_pylist()]
    return sorted(found, key=lambda row: (row["seed"], row["step"]))


def policy_of(folder, seed=1):
    return LaneChoice(seed=(seed,)).lane_in(PolicySource.of_folder(folder, lambda name: TASK), WalkConfig())[0]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    run(out)
    return out


def test_a_stopped_run_goes_on_to_the_same_rows_and_parameters(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(2), pytest.raises(Interrupted):
        run(out)
    assert max(row["step"] for row in rows(out)) < 48
    run(out, resume=True)
    assert rows(out) == rows(whole)
    mine, again = (jax.tree.leaves(policy_of(folder)) for folder in (whole, out))
    assert all(np.array_equal(a, b) for a, b in zip(mine, again, strict=True))
    last = rows(whole)[-1]
    assert last["train_guided_share"] > 0
    assert np.isfinite(last["train_loss"])


def test_what_is_loaded_acts_as_what_was_evaluated(whole):
    policy = policy_of(whole)
    assert isinstance(policy, Agent)
    last = next(row for row in rows(whole) if (row["seed"], row["step"]) == (1, 48))
    found = rollout_with_progress(ENV, policy, episodes(), CONFIG.schedule.eval_envs, CONFIG.schedule.eval_steps).means
    assert float(found["reward"]) == last["reward"]


def test_the_agent_is_exported_as_it_acts(whole, tmp_path):
    policy = policy_of(whole)
    written = contract.write(policy, ENV, partial(decisions.observations, ENV, policy, 32), "onnx", tmp_path, {})
    assert written["difference"] <= decisions.TOLERANCE
    assert written["action"]["space"]["name"] == "box"
    assert written["policy"]["agent"]["name"] == "sac"


def test_a_policy_folder_can_keep_the_agent(whole):
    agent = policy_of(whole)
    again = serialization.from_json(serialization.to_json(agent), ENV)
    again = serialization.with_arrays(again, serialization.arrays_of(agent))
    obs = jnp.linspace(-1.0, 1.0, 8).reshape(4, 2)
    np.testing.assert_array_equal(*(policy.act(jax.random.key(0), None, obs) for policy in (agent, again)))


def test_replay_tells_ends_by_time_from_terminations_and_guided_steps():
    lane = loop.lane_of(CONFIG.sizes, loop.parts_of(CONFIG), registry.make("heuristic", CONFIG.sizes, ENV), 0, ENV)
    clock, state = loop.start_clock(), jax.jit(lambda key: lane.init(ENV, key, 0))(jax.random.key(0))
    iterate = jax.jit(lane.iterate)
    for _ in range(8):
        state, _ = iterate(ENV, CONFIG.settings, clock, state)
        clock = lane.advance(clock, CONFIG.schedule)
    columns = np.asarray(state.agent.replay)  # place, time, two entries, reward, discount, ended, next place and time
    discount, ended, place, time = columns[:, 5], columns[:, 6], columns[:, 7], columns[:, 8]
    off = np.abs(place) > walk_task.EDGE
    assert (ended == 1).any()
    np.testing.assert_array_equal(discount, np.where(off, 0, 1))
    np.testing.assert_array_equal(ended == 1, off | (time >= 1))  # the observation before the reset
    np.testing.assert_allclose(place, columns[:, 0] + 0.25 * (columns[:, 2] - 1), atol=1e-6)
    # Of 32 rows those whose action is the heuristic's are counted, after the random steps.
    told = np.asarray(jax.vmap(ENV.heuristic)(jnp.asarray(columns[:, :2])))
    by_guide = np.isclose(told, columns[:, 2:4], atol=1e-6).all(-1)
    np.testing.assert_array_equal(np.asarray(state.agent.guided)[:, 0], np.cumsum(by_guide))
    assert 0 < by_guide.sum() < 24
