"""Lanes whose arbiter acts in the finished policy: stopped, resumed, loaded, exported, and where none can be kept."""

import dataclasses
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from small_runs import stopping_at

from cuelearner_jax.adaptation import serialization
from cuelearner_jax.arbiters import by_value, prior
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes, rollout_with_progress
from cuelearner_jax.export import contract, decisions
from cuelearner_jax.policies import Agent, Arbitrated
from cuelearner_jax.runs.grid import Grid
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.trained import PolicySource, one_policy
from cuelearner_jax.storage import results
from cuelearner_jax.studies import train
from cuelearner_jax.task import Body, Task
from cuelearner_jax.terminal import Interrupted


@dataclass(frozen=True)
class AimedConfig:
    """The bandit with aims."""

    offset: float = 0.6
    """Turn of the best action."""
    features: int = 4
    """Numbers that tell an aim."""


class Told(probes.Aimed):
    width = 4

    def aims(self, obs):
        found = super().aims(obs)
        return found._replace(features=found.features[:, : self.width])


class ToldLess(Told):
    width = 3


def environment(config, split):
    return (Told if config.features == 4 else ToldLess)(offset=jnp.float32(config.offset))


BODY = Body("point", "", environment)
TASK = Task("aimed", "the bandit with aims", AimedConfig, (BODY,), teacher=lambda config, env: probes.Expert(env))
ARBITER = prior.Config(own_share=0.25, near_actions=4, directions=12, judge_steps=100)
SCHEDULE = {"total_steps": 48, "guidance_until": 48, "eval_every": 16, "checkpoint_every": 16}
CONFIG = dataclasses.replace(
    probes.config(ARBITER, sizes={"fit_steps": 60, "lanes_per_block": 1}, schedule=SCHEDULE), task=AimedConfig()
)
GRID = Grid(("intent",), (0, 1), (20,))


def run(out, config=CONFIG, **options):
    train.run(Order(TASK, config, GRID, out, **options))


def rows(out):
    names = ("seed", "step", "reward", "arm", "train_loss", *(f"judged_{arm}" for arm in prior.ARMS))
    found = [{name: row[name] for name in names} for row in results.read(out).to_pylist()]
    return sorted(found, key=lambda row: (row["seed"], row["step"]))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    run(out)
    return out


def source(folder):
    return PolicySource.of_run(folder, lambda name: TASK)


def agent_of(folder, seed=1):
    return one_policy(source(folder), source(folder).config.task, "agent", None, None, seed)


def test_a_stopped_run_goes_on_to_the_same_rows(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(2 + 2), pytest.raises(Interrupted):
        run(out)
    run(out, resume=True)
    assert rows(out) == rows(whole)


def test_what_is_loaded_acts_as_what_was_evaluated(whole):
    policy = agent_of(whole)
    assert isinstance(policy, Arbitrated)
    last = next(row for row in rows(whole) if (row["seed"], row["step"]) == (1, 48))
    assert int(policy.arm) == last["arm"]
    assert float(policy.steps) == 48 - CONFIG.schedule.learn_after
    env = environment(CONFIG.task, "validation")
    found = rollout_with_progress(env, policy, episodes(), CONFIG.schedule.eval_envs, CONFIG.schedule.eval_steps).means
    assert float(found["reward"]) == last["reward"]
    assert last["reward"] == 1.0  # twenty answers about aims tell the best


@pytest.mark.parametrize(
    ("format", "arm"),
    [
        ("numpy", "prior"),
        *(pytest.param("numpy", arm, marks=pytest.mark.long) for arm in prior.ARMS if arm != "prior"),
        pytest.param("stablehlo", "prior", marks=pytest.mark.long),
    ],
)
def test_each_arm_is_exported_as_it_acts(whole, tmp_path, format, arm):
    env = environment(CONFIG.task, "validation")
    one = agent_of(whole).replace(arm=jnp.asarray(prior.ARMS.index(arm)))
    drawn = partial(decisions.observations, env, one, 32)
    written = contract.write(one, env, drawn, format, tmp_path / arm, {})
    assert written["difference"] <= decisions.TOLERANCE
    assert written["policy"]["arm"] == arm
    assert written["policy"]["base"]["policy"] == "agent"


def test_a_policy_folder_refuses_it_in_one_line(whole):
    with pytest.raises(UserError, match="a policy of kind arbitrated cannot be stored in a folder") as told:
        serialization.to_json(agent_of(whole))
    assert "\n" not in str(told.value)


def test_aims_that_are_told_otherwise_are_refused(whole):
    of = source(whole)
    of.check("agent", AimedConfig(offset=0.1))
    with pytest.raises(UserError, match="uses aims of 4 features, this world's have 3"):
        of.check("agent", AimedConfig(features=3))


@pytest.mark.long
def test_the_finished_policy_by_value_is_the_agent(tmp_path):
    config = dataclasses.replace(CONFIG, arbiter=by_value.Config())
    run(tmp_path / "run", config)
    assert isinstance(agent_of(tmp_path / "run"), Agent)
    with stopping_at(2 + 2), pytest.raises(Interrupted):
        run(tmp_path / "other", config)
    run(tmp_path / "other", config, resume=True)
    one, other = (results.read(tmp_path / name).sort_by("step")["reward"].to_pylist() for name in ("run", "other"))
    assert one == other
    mine, again = (jax.tree.leaves(agent_of(tmp_path / name).params) for name in ("run", "other"))
    assert all(np.array_equal(a, b) for a, b in zip(mine, again, strict=True))
