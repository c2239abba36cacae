"""Configuration: what cannot work is refused with its name, hashes are stable, JSON comes back as it was."""

import dataclasses
import json

import probes
import pytest

from cuelearner_jax import config, run_config
from cuelearner_jax.arbiters import Episodes, Paced
from cuelearner_jax.config import Scalars
from cuelearner_jax.errors import UserError


@pytest.mark.parametrize(
    ("group", "values", "message"),
    [
        ("sizes", {"num_envs": 0}, "sizes.num_envs is 0: give a positive number"),
        ("agent", {"q_layers": ()}, "agent.q_layers is empty: give at least one layer"),
        ("agent", {"q_layers": 32}, "agent.q_layers is 32: give a value of type"),
        ("agent", {"replay_capacity": 4001}, "agent.replay_capacity is 4001: give a multiple of sizes.num_envs"),
        ("scalars", {"eps_deg": 181.0}, "scalars.eps_deg is 181.0: give a number above 0 and up to 180"),
        ("scalars", {"answer": "worst"}, "scalars.answer is 'worst': choose one of best, nearest, shuffled"),
        ("schedule", {"total_steps": 2**31}, "schedule.total_steps is 2147483648: give at most 2147483647"),
        ("schedule", {"eval_every": 18}, "schedule.eval_every is 18: give a multiple of sizes.num_envs"),
        ("schedule", {"eval_steps": 25}, "schedule.eval_steps is 25: give a multiple of schedule.eval_envs"),
        ("sizes", {"ask_all": True}, "sizes.ask_all asks about every candidate: give sizes.candidates above 1 too"),
        ("sizes", {"ask_all": True, "candidates": 4}, "sizes.labels_per_round is 10: give a multiple of sizes.candi"),
        ("agent", {"coarse_directions": 4, "peaks": 5}, "agent.peaks is 5: give at most"),
        ("sizes", {"candidates": 8}, "sizes.candidates is 8: questions are chosen by the disagreement of members"),
    ],
)
def test_values_that_cannot_work_are_refused(group, values, message):
    with pytest.raises(UserError) as error:
        run_config.check(probes.config(**{group: values}))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_options_of_a_part_are_checked_under_its_name():
    with pytest.raises(UserError, match=r"arbiter\.probability is 1\.5: give a number from 0 to 1"):
        run_config.check(probes.config(arbiter=Episodes(1.5)))
    with pytest.raises(UserError, match=r"arbiter\.lead is -1"):
        run_config.check(probes.config(arbiter=Paced(lead=-1.0)))


def test_a_run_s_options_come_back_from_json_with_their_parts():
    asked = dataclasses.replace(probes.CONFIG, arbiter=Paced(lead=0.5))
    told = json.loads(json.dumps(run_config.to_json(asked)))
    assert (told["agent"]["name"], told["arbiter"]["name"]) == ("ddqn", "paced")
    assert run_config.from_json(asked.task, told) == asked
    with pytest.raises(UserError, match="unknown agent 'gone'"):
        run_config.from_json(asked.task, {**told, "agent": {"name": "gone"}})


def test_the_digest_does_not_change_from_version_to_version():
    # Hashes stand in published results: if this fails, old results can no longer be told to be of one configuration.
    assert config.digest({"a": 1, "b": [1.5, "x"]}) == config.digest({"b": [1.5, "x"], "a": 1}) == "d7aa7c69cbeb"


def test_an_unknown_field_is_named_and_a_missing_one_has_its_default():
    with pytest.raises(UserError, match=r"learning_rat is 0\.1 in a file of another version"):
        config.from_json(Scalars, {"learning_rat": 0.1})
    assert config.from_json(Scalars, {"eps_deg": 7.0}) == Scalars(eps_deg=7.0)
