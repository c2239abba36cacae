"""Configuration: what cannot work is refused with its name, hashes are stable, JSON comes back as it was."""

import dataclasses
import json
import math

import jax
import probes
import pytest

from cuelearner_jax import config
from cuelearner_jax.config import RunConfig, Scalars, Schedule, Sizes
from cuelearner_jax.errors import UserError


@pytest.mark.parametrize(
    ("group", "values", "message"),
    [
        ("sizes", {"directions": 0}, "sizes.directions is 0"),
        ("sizes", {"target_directions": -1}, "sizes.target_directions is -1"),
        ("sizes", {"num_envs": 0}, "sizes.num_envs is 0"),
        ("sizes", {"batch_size": 0}, "sizes.batch_size is 0"),
        ("sizes", {"replay_capacity": 0}, "sizes.replay_capacity is 0"),
        ("sizes", {"updates_per_step": 0}, "sizes.updates_per_step is 0"),
        ("sizes", {"labels_per_round": 0}, "sizes.labels_per_round is 0"),
        ("sizes", {"fit_steps": 0}, "sizes.fit_steps is 0"),
        ("sizes", {"fit_batch_size": 0}, "sizes.fit_batch_size is 0"),
        ("sizes", {"validate_every": 0}, "sizes.validate_every is 0"),
        ("sizes", {"guide_directions": 0}, "sizes.guide_directions is 0"),
        ("sizes", {"replay_steps": 0}, "sizes.replay_steps is 0"),
        ("sizes", {"lanes_per_block": -1}, "sizes.lanes_per_block is -1"),
        ("sizes", {"q_layers": ()}, "at least one layer"),
        ("sizes", {"feedback_layers": ()}, "at least one layer"),
        ("sizes", {"q_layers": (32, 0)}, "positive width"),
        ("sizes", {"replay_capacity": 4001}, "sizes.replay_capacity is 4001: give a multiple of sizes.num_envs"),
        ("sizes", {"fit_steps": 210}, "sizes.fit_steps is 210: give a multiple of sizes.validate_every"),
        ("scalars", {"learning_rate": -0.1}, "scalars.learning_rate is -0.1"),
        ("scalars", {"max_grad_norm": -1.0}, "scalars.max_grad_norm is -1.0"),
        ("scalars", {"k_max": -1}, "scalars.k_max is -1"),
        ("scalars", {"tau_deg": -1.0}, "scalars.tau_deg is -1.0"),
        ("scalars", {"eps_deg": 0.0}, "scalars.eps_deg is 0"),
        ("scalars", {"eps_deg": 181.0}, "scalars.eps_deg is 181.0"),
        ("scalars", {"discount": 1.0}, "scalars.discount is 1.0"),
        ("scalars", {"discount": -0.5}, "scalars.discount is -0.5"),
        ("scalars", {"guided_probability": 1.5}, "scalars.guided_probability is 1.5: give a number from 0 to 1"),
        ("scalars", {"pace_window": 0.5}, "scalars.pace_window is 0.5: give at least 1 episode"),
        ("scalars", {"pace_floor": 0.6}, "scalars.pace_floor is 0.6: give at most 0.5"),
        ("scalars", {"mistake_probability": -0.1}, "scalars.mistake_probability is -0.1"),
        ("scalars", {"silence_probability": 2.0}, "scalars.silence_probability is 2.0"),
        ("scalars", {"refined_fraction": 1.1}, "scalars.refined_fraction is 1.1"),
        ("scalars", {"answer": "worst"}, "scalars.answer is 'worst': give best or nearest"),
        ("scalars", {"nearest_share": 1.1}, "scalars.nearest_share is 1.1: give a number from 0 to 1"),
        ("scalars", {"nearest_aim_deg": -1.0}, "scalars.nearest_aim_deg is -1.0: give a number that is not negative"),
        ("scalars", {"scalar_within_deg": math.nan}, "scalars.scalar_within_deg is nan"),
        ("scalars", {"explored_fraction": 1.5}, "scalars.explored_fraction is 1.5: give a number from 0 to 1"),
        ("scalars", {"correction_replay": 0}, "scalars.correction_replay is 0: give a positive number"),
        ("scalars", {"polyak": 1.5}, "scalars.polyak is 1.5: give a number from 0 to 1"),
        ("scalars", {"learning_rate": math.nan}, "scalars.learning_rate is nan: give a finite number"),
        ("scalars", {"teacher_bias_deg": -math.inf}, "scalars.teacher_bias_deg is -inf: give a finite number"),
        ("scalars", {"max_grad_norm": 0.0}, "scalars.max_grad_norm is 0.0: give a positive number"),
        ("schedule", {"total_steps": 0}, "schedule.total_steps is 0"),
        ("schedule", {"eval_every": 0}, "schedule.eval_every is 0"),
        ("schedule", {"eval_steps": 0}, "schedule.eval_steps is 0"),
        ("schedule", {"eval_envs": 0}, "schedule.eval_envs is 0"),
        ("schedule", {"checkpoint_every": 0}, "schedule.checkpoint_every is 0"),
        ("schedule", {"target_every": 0}, "schedule.target_every is 0"),
        ("schedule", {"eval_every": 18}, "schedule.eval_every is 18: give a multiple of sizes.num_envs"),
        ("schedule", {"total_steps": 50}, "schedule.total_steps is 50: give a multiple of schedule.eval_every"),
        ("schedule", {"checkpoint_every": 24}, "schedule.checkpoint_every is 24: give a multiple"),
        ("schedule", {"eval_steps": 25}, "schedule.eval_steps is 25: give a multiple of schedule.eval_envs"),
        ("sizes", {"ensemble": 0}, "sizes.ensemble is 0"),
        ("sizes", {"candidates": 0}, "sizes.candidates is 0"),
        ("sizes", {"ask_all": True}, "sizes.ask_all asks about every candidate: give sizes.candidates above 1 too"),
        (
            "sizes",
            {"ask_all": True, "candidates": 4},
            "sizes.labels_per_round is 10: give a multiple of sizes.candidates",
        ),
        ("sizes", {"candidates": 8}, "sizes.candidates is 8: questions are chosen by the disagreement of members"),
        ("sizes", {"candidates": 8}, "give a sizes.ensemble above 1 too, or sizes.ask_all"),
        ("scalars", {"ask_bound_deg": 20.0}, "ask_bound_deg is 20.0, which bounds later instalments, and there is but"),
        ("scalars", {"ask_bound_deg": 0.0}, "scalars.ask_bound_deg is 0.0: give an angle"),
        ("schedule", {"ask_at": ()}, "schedule.ask_at is empty: give steps in ascending order, the first of them 0"),
        ("schedule", {"ask_at": (16,)}, "schedule.ask_at is 16: give steps in ascending order, the first of them 0"),
        ("schedule", {"ask_at": (0, 16, 16)}, "schedule.ask_at is 0 16 16: give steps in ascending order"),
        ("schedule", {"ask_at": (0, 10)}, "schedule.ask_at is 10: give a multiple of schedule.eval_every (16)"),
        ("schedule", {"ask_at": (0, 32)}, "schedule.ask_at is 0 32: give steps below schedule.guidance_until (24)"),
        (
            "schedule",
            {"ask_at": (0, 48), "guidance_until": 100},
            "schedule.ask_at is 0 48: give steps below schedule.total_steps (48)",
        ),
        ("schedule", {"guide_eval_every": -10}, "schedule.guide_eval_every is -10"),
        ("schedule", {"guide_eval_every": 15}, "schedule.guide_eval_every is 15: give a multiple of sizes.labels"),
    ],
)
def test_values_that_cannot_work_are_refused(group, values, message):
    with pytest.raises(UserError) as error:
        config.check(probes.config(**{group: values}))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_defaults_and_probes_can_work():
    config.check(RunConfig(probes.WindowConfig()))
    config.check(probes.CONFIG)
    config.check(probes.config(scalars={"teacher_bias_deg": -3.0, "eps_deg": 180.0, "k_max": 0}))


def test_bootstraps_with_a_discount():
    assert not probes.config(scalars={"discount": 0.0}).bootstraps
    assert probes.config(scalars={"discount": 0.1}).bootstraps


def test_scalars_and_schedule_are_trees_of_their_numbers_and_sizes_are_not():
    words = {"answer": "nearest"}
    assert len(jax.tree.leaves(Scalars())) == len(dataclasses.fields(Scalars)) - len(words)
    for name, word in words.items():  # part of the program
        other = dataclasses.replace(Scalars(), **{name: word})
        assert jax.tree.structure(other) != jax.tree.structure(Scalars())
    assert len(jax.tree.leaves(Schedule())) == len(dataclasses.fields(Schedule))
    assert hash(Sizes()) == hash(Sizes())


@pytest.mark.parametrize("group", [Scalars(), Schedule()])
def test_other_scalars_and_schedules_compile_nothing_again(group):
    traced = []

    @jax.jit
    def total(group):
        traced.append(group)
        return sum(jax.tree.leaves(group))

    before = sum(jax.tree.leaves(group))
    assert float(total(group)) == pytest.approx(before)
    numbers = {name: value for name, value in dataclasses.asdict(group).items() if not isinstance(value, str)}
    for name, value in numbers.items():
        several = isinstance(value, tuple)  # of which the number is fixed
        (first, *rest) = value if several else (value,)
        other = 2 * first + type(first)(1000)
        changed = dataclasses.replace(group, **{name: (other, *rest) if several else other})
        assert float(total(changed)) == pytest.approx(before + first + 1000)
    assert len(traced) == 1
    assert type(traced[0]) is type(group)


def test_the_digest_does_not_change_from_version_to_version():
    # Hashes stand in published results: if this fails, old results can no longer be told to be of one configuration.
    assert config.digest({"a": 1, "b": [1.5, "x"]}) == "d7aa7c69cbeb"


def test_the_digest_depends_on_values_and_not_on_order():
    values = config.to_json(probes.SIZES)
    assert config.digest(values) == config.digest(dict(reversed(values.items())))
    assert config.digest(values) != config.digest(values | {"directions": 17})
    assert len(config.digest(values)) == 12


@pytest.mark.parametrize("group", [probes.SIZES, probes.SCALARS, probes.SCHEDULE])
def test_the_digest_depends_on_every_field(group):
    values = config.to_json(group)
    changed = {name: config.digest(values | {name: [value, "another"]}) for name, value in values.items()}
    assert len(set(changed.values()) | {config.digest(values)}) == len(values) + 1


@pytest.mark.parametrize("group", [probes.SIZES, probes.SCALARS, probes.SCHEDULE, probes.WindowConfig(3.5)])
def test_json_comes_back_as_it_was(group):
    text = json.dumps(config.to_json(group))
    assert config.from_json(type(group), json.loads(text)) == group


def test_an_unknown_field_is_named():
    with pytest.raises(UserError, match=r"unknown field 'learning_rat' for Scalars"):
        config.from_json(Scalars, {"learning_rat": 0.1})


def test_fields_that_a_file_lacks_get_their_defaults():
    assert config.from_json(Scalars, {"eps_deg": 7.0}) == Scalars(eps_deg=7.0)
