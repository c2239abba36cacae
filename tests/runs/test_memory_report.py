"""Sizes: whatever whole number is given is refused in one line, or counted in 32 bits and fits the memory there is."""

import dataclasses

import jax
import numpy as np
import probes
import pytest
from probes import Aimed, Window

from cuelearner_jax import run_config
from cuelearner_jax.config import LARGEST, Scalars, Schedule, Sizes
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import intent, registry
from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.runs import memory_report
from cuelearner_jax.runs.grid import Grid, check_grid
from cuelearner_jax.runs.lanes import LaneGroup
from cuelearner_jax.task import shape_of

FREE = 16e9  # bytes
VALUES = (-1, 0, 10**9, 10**10, 10**20, 10**400)
FIELDS = [
    (group, field.name)
    for group, kind in (("sizes", Sizes), ("scalars", Scalars), ("schedule", Schedule))
    for field in dataclasses.fields(kind)
    if isinstance(getattr(kind(), field.name), int | tuple)
]


@pytest.fixture(autouse=True)
def memory(monkeypatch):
    monkeypatch.setattr(memory_report, "free_bytes", lambda: FREE)


def report(config: RunConfig, kind: str, labels: int = 20) -> str:
    """What a sweep looks at before it makes anything."""
    run_config.check(config)
    grid = Grid((kind,), (0, 1), (labels,))
    check_grid(grid)
    env = jax.eval_shape(Aimed)
    return memory_report.memory_report(LaneGroup(config, env, config.guide_in(env, kind), grid))


@pytest.mark.parametrize(
    "kind", ["relative", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("none", "intent"))]
)
@pytest.mark.parametrize(("group", "name"), FIELDS)
def test_any_whole_number_is_refused_or_fits(group, name, kind):
    base = probes.config(scalars={"discount": 0.9})
    # Others that must be multiples of the field, or it of them, are no reason to refuse.
    wide = {"sizes": {"num_envs": 1, "validate_every": 1}, "schedule": {"eval_every": 1, "eval_envs": 1}}
    tall = {"eval_envs": {"eval_steps": LARGEST}, "eval_every": {"total_steps": LARGEST, "checkpoint_every": LARGEST}}
    tall["validate_every"], tall["num_envs"] = {"fit_steps": LARGEST}, {}
    for value in VALUES:
        parts = {part: dataclasses.asdict(getattr(base, part)) | wide.get(part, {}) for part in ("sizes", "schedule")}
        for other in tall.get(name, {}):
            parts[group][other] = value
        parts.setdefault(group, dataclasses.asdict(getattr(base, group)))
        parts[group][name] = (value,) if isinstance(parts[group][name], tuple) else value
        changed = {part: dataclasses.replace(getattr(base, part), **values) for part, values in parts.items()}
        config = dataclasses.replace(base, **changed)
        try:
            told = report(config, kind)
        except UserError as refusal:
            assert "\n" not in str(refusal)
            continue
        assert abs(value) <= LARGEST
        assert float(told.split(" GB in all")[0].split()[-1]) * 1e9 <= FREE
        np.asarray(jax.tree.leaves((config.scalars, config.schedule)), np.float32)
        for number in jax.tree.leaves(config.schedule):
            np.int32(number)


LARGE = [
    ("sizes", {"fit_batch_size": 10**9}, "--sizes.fit-batch-size"),
    ("agent", {"batch_size": 10**9}, "--agent.batch-size"),
    ("agent", {"directions": 10**9}, "--agent.directions"),
    ("sizes", {"labels_per_round": 10**9}, "--labels"),
    ("agent", {"q_layers": (10**6, 10**6)}, "the networks of --agent"),
    ("sizes", {"feedback_layers": (10**6, 10**6)}, "--sizes.feedback-layers"),
    ("sizes", {"fit_steps": 2 * 10**9}, "--sizes.fit-steps"),
    ("agent", {"replay_capacity": 2 * 10**9}, "--agent.replay-capacity"),
    ("schedule", {"eval_envs": 10**9, "eval_steps": 10**9}, "--schedule.eval-envs"),
    ("schedule", {"eval_steps": 2 * 10**9, "eval_envs": 1}, "--schedule.eval-steps"),
]


@pytest.mark.parametrize(("group", "values", "option"), LARGE, ids=[option for *_, option in LARGE])
def test_what_takes_the_memory_is_named(group, values, option):
    with pytest.raises(UserError, match=f"16.0 GB are free: .*lower {option}"):
        report(probes.config(**{group: values}), "relative")


def test_layers_that_a_guide_has_not_take_no_memory():
    wide = (10**6, 10**6)
    aims = dataclasses.replace(probes.CONFIG, kinds={"intent": intent.Config(aim_layers=wide)})
    with pytest.raises(UserError, match=r"lower --intent\.aim-layers"):
        report(aims, "intent")
    with pytest.raises(UserError, match=r"lower --sizes\.feedback-layers"):
        report(probes.config(sizes={"feedback_layers": wide}), "relative")
    assert report(aims, "relative") == report(probes.CONFIG, "relative")


def test_a_guide_of_aims_takes_memory_for_each_of_them():
    with pytest.raises(UserError, match="lower --labels"):
        report(dataclasses.replace(probes.CONFIG, kinds={"intent": intent.Config((1000,))}), "intent", labels=500_000)
    assert report(probes.config(sizes={"feedback_layers": (1000,)}), "relative", labels=500_000)


def test_fewer_lanes_are_advised_where_some_would_fit():
    config, env = probes.config(agent={"replay_capacity": 10**8}), jax.eval_shape(Window)
    group = LaneGroup(config, env, registry.make("none", config.sizes, env), Grid(("none",), tuple(range(20)), ()))
    with pytest.raises(UserError, match=r"at most 7 at once, or lower --agent\.replay-capacity"):
        memory_report.memory_report(group)


def test_worlds_are_counted():
    from cuelearner_jax.tasks import registry as tasks

    task = tasks.find("navigation")
    config = task.presets["quickstart"].config
    many = dataclasses.replace(config, task=dataclasses.replace(config.task, worlds=10**7))
    for wanted, refused in ((config, False), (many, True)):
        env = shape_of(task, wanted.task)
        group = LaneGroup(wanted, env, registry.make("none", wanted.sizes, env), Grid(("none",), (0,), ()))
        if refused:
            with pytest.raises(UserError, match="lower --task"):
                memory_report.memory_report(group)
        else:
            assert "1 lanes" in memory_report.memory_report(group)
