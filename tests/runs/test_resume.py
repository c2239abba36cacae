"""Runs that were stopped or killed and resumed: bitwise the run that was left alone; what is damaged is refused."""

import dataclasses
import json
import shutil
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import jax
import numpy as np
import probes
import pytest
from small_runs import stopping_at

from cuelearner_jax.arbiters import Paced
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.runs import lanes, runner, training
from cuelearner_jax.runs.grid import Grid, run_key
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.policy_sources import PolicySource
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import formats, label_files, results
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.studies import train
from cuelearner_jax.terminal import Interrupted

EPISODES = {"eval_envs": 40, "eval_steps": 40}  # of every evaluation
# Bootstraps and is paced, so that target network, next observations, Adam's moments and what each arm has earned are in
# the checkpoint as well.
CONFIG = probes.config(
    sizes={"feedback_layers": (16,), "lanes_per_block": 2, "fit_steps": 100},
    scalars={"discount": 0.5, "silence_probability": 0.05},
    agent={"q_layers": (16,), "replay_capacity": 40},
    arbiter=Paced(lead=0.0),
    schedule={"total_steps": 96, "guidance_until": 64, "eval_every": 16, "checkpoint_every": 32} | EPISODES,
)
GRID = Grid(("relative", "none"), seeds=(3, 5), labels=(35, 60))  # 6 rounds; 4 lanes in 2 blocks of 2
TASK = probes.make_task()
VOLATILE = ("wall_s", "commit", "command", "folder")


class Killed(Exception):
    """Stands for a kill: nothing that comes after it in the program runs."""


@pytest.fixture(autouse=True, scope="module")
def compiled_once():
    """Begin with arrays that are tied to a device, as restored ones are: programs compile once. Save each 2 rounds."""

    def committed(make):
        return lambda *arguments: jax.device_put(make(*arguments), jax.devices()[0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lanes.LaneGroup, "start", committed(lanes.LaneGroup.start))
        patch.setattr(training, "start_clock", committed(start_clock))
        patch.setattr(runner, "ROUNDS_A_CHUNK", 2)
        yield


@contextmanager
def killed_at(when, method):
    """A kill in place of the given call of a method of the runner."""
    calls = 0
    usual = getattr(runner.Runner, method)

    def counted(self, *arguments):
        nonlocal calls
        calls += 1
        if calls == when:
            raise Killed
        return usual(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner.Runner, method, counted)
        yield


def run(out, **options):
    train.run(Order(TASK, CONFIG, GRID, out, **options))


def newest(out, kind, grid=GRID):
    """The newest checkpoint's arrays and number."""
    env = TASK.environment(CONFIG.task)
    group = lanes.LaneGroup(CONFIG, env, guidances.make(kind, CONFIG.sizes, env), grid)
    like = training.items(group.shapes_of(group.cut), jax.eval_shape(start_clock), 0.0)
    key = run_key(formats.read("config", out / "config.json"), kind)
    with Checkpoints(out / kind / "checkpoints", read_only=True, run=key) as saved:
        found = saved.restore(like)
        del found["clock"]["wall_s"]
        return found, saved.latest()


def rows(out):
    table = results.read(out)
    return table.drop_columns([name for name in VOLATILE if name in table.column_names]).to_pylist()


def read_labels(out):
    file = label_files.read(out / "relative" / "labels.parquet")
    return [file.seeds, file.labels.obs, file.labels.action, file.labels.answer]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole") / "run"
    run(out)
    return out


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run that was stopped at step 48 of its first kind."""
    out = tmp_path_factory.mktemp("stopped") / "run"
    with stopping_at(6 + 3), pytest.raises(Interrupted, match="step 48 of relative"):
        run(out)
    return out


def copied(folder, tmp_path):
    return Path(shutil.copytree(folder, tmp_path / "copy" / "run"))


@cache
def kept_by(whole):
    """Each kind's newest checkpoint of a run that nobody changes."""
    return {kind: newest(whole, kind) for kind in GRID.guidance}


def assert_same_run(out, whole):
    for kind in GRID.guidance:
        (mine, number), (expected, last) = newest(out, kind), kept_by(whole)[kind]
        assert number == last
        assert jax.tree.structure(mine) == jax.tree.structure(expected)
        for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(expected), strict=True):
            assert one.dtype == other.dtype
            assert np.asarray(probes.words(one)).tobytes() == np.asarray(probes.words(other)).tobytes()
        assert not (out / kind / results.JSONL).exists()
    assert rows(out) == rows(whole)
    for mine, expected in zip(read_labels(out), read_labels(whole), strict=True):
        np.testing.assert_array_equal(mine, expected)


def test_a_run_leaves_a_row_for_each_lane_and_evaluation(whole):
    table = rows(whole)
    steps = list(range(0, 97, 16))
    for kind, budgets in (("relative", (35, 60)), ("none", (0,))):
        found = sorted((row["labels"], row["seed"], row["step"]) for row in table if row["guidance"] == kind)
        assert found == sorted((budget, seed, step) for budget in budgets for seed in GRID.seeds for step in steps)
    last = [row for row in table if row["step"] == 96]
    assert len({row["train_loss"] for row in last}) == 6  # six lanes, six results
    assert all(row["guide_reward"] is not None for row in table if row["step"] == 0)
    assert {row["config_hash"] for row in table} == {table[0]["config_hash"]}
    assert {(row["episodes"], len(row["reward_each"])) for row in table} == {(40, 20)}
    assert all(np.mean(row["reward_each"]) == pytest.approx(row["reward"], abs=1e-6) for row in table)
    state, number = kept_by(whole)["relative"]
    assert number == 6 + 96
    assert state["rest"][0].agent.training.target_params is not None
    assert (state["rest"][0].arbiter.sums.episodes > 0).all()
    assert len({row["train_guided_share"] for row in table if row["guidance"] == "relative" and row["step"] == 48}) > 1
    assert all(row["train_guided_share"] == 0 for row in table if row["guidance"] == "none" and row["step"])
    assert int(state["clock"]["clock"].update) == 96


def test_a_run_that_is_cut_short_again_and_again_while_it_asks_goes_on_as_one(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(3), pytest.raises(Interrupted, match="--resume"):
        run(out)
    assert newest(out, "relative")[1] == 3
    # Round 4 is saved, round 5 is asked, then the process dies.
    with killed_at(2, "_stop_on_signal"), pytest.raises(Killed):
        run(out, resume=True)
    assert newest(out, "relative")[1] == 4
    assert not (out / "relative" / "labels.parquet").exists()
    with killed_at(1, "_train"), pytest.raises(Killed):  # all labels are there, and no row
        run(out, resume=True)
    with killed_at(1, "_stop_on_signal"), pytest.raises(Killed):
        run(out, resume=True)
    assert {row["step"] for row in rows(out)} == {0, 16}
    run(out, resume=True)
    assert_same_run(out, whole)


def test_a_run_that_is_cut_short_again_and_again_while_it_trains_goes_on_as_one(stopped, whole, tmp_path):
    out = copied(stopped, tmp_path)
    assert newest(out, "relative")[1] == 6 + 48
    with (out / "relative" / results.JSONL).open("a") as table:  # what a kill can tear is written anew
        table.write('{"step": 48, "se')
    (out / "relative" / label_files.PARQUET).write_bytes(b"PAR1")
    # The row of step 80 is on disk, its checkpoint (at 64) is not the newest state.
    with killed_at(2, "_stop_on_signal"), pytest.raises(Killed):
        run(out, resume=True)
    assert newest(out, "relative")[1] == 6 + 64
    assert max(row["step"] for row in rows(out)) == 80
    # And once more in the other kind, after the row and before the checkpoint of its first saved step.
    with killed_at(3, "_save"), pytest.raises(Killed):
        run(out, resume=True)
    assert (out / "relative" / results.PARQUET).exists()
    assert newest(out, "none")[1] == 32
    assert max(row["step"] for row in rows(out) if row["guidance"] == "none") == 64
    run(out, resume=True)
    assert_same_run(out, whole)
    before = probes.files_of(out)
    run(out, resume=True)  # a finished run
    assert probes.files_of(out) == before


def test_labels_of_a_file_are_used_exactly(tmp_path):
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, (2, 2, 60))
    obs, action = np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)
    answer = rng.integers(-1, 2, size=(2, 60, 1)).astype(np.float32)
    given = probes.label_set(obs, action, answer, np.ones((2, 60), bool))
    path = tmp_path / "given.parquet"
    label_files.write(path, {"name": "window"}, "relative", DIRECTIONS, CONFIG.scalars.eps_deg, np.array([3, 5]), given)
    grid = Grid(("relative",), seeds=(5, 3), labels=(35, 60))
    out = tmp_path / "run"

    def refuse(config, env):
        raise AssertionError("a teacher was made although the labels are given")

    train.run(Order(dataclasses.replace(TASK, teacher=refuse), CONFIG, grid, out, labels_from=path))
    state, _ = newest(out, "relative", grid)
    labels = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(block.guide.labels for block in state["rest"]))
    for lane, (seed, budget) in enumerate([(1, 35), (0, 35), (1, 60), (0, 60)]):
        np.testing.assert_array_equal(labels.valid[lane], np.arange(60) < budget)
        for name in ("obs", "action", "answer"):
            np.testing.assert_array_equal(getattr(labels, name)[lane, :budget], getattr(given, name)[seed, :budget])
    assert all(bool(block["guidance"].fitted.all()) for block in state["policy"])
    written = label_files.read(out / "relative" / "labels.parquet")
    assert written.seeds.tolist() == [5] * 60 + [3] * 60
    np.testing.assert_array_equal(written.labels.answer, np.concatenate([answer[1], answer[0]]))


# What is lost or changed is said before anything goes on.


def refused(out, message):
    before = probes.files_of(out)
    with pytest.raises(UserError, match=message) as refusal:
        run(out, resume=True)
    assert "\n" not in str(refusal.value)
    assert probes.files_of(out) == before


def test_a_damaged_checkpoint_is_refused_and_the_one_before_serves(stopped, whole, tmp_path):
    out = copied(stopped, tmp_path)
    newest_folder = out / "relative" / "checkpoints" / str(6 + 48)
    for path in (newest_folder / "rest").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    refused(out, "cannot be read")
    newest_folder.rename(tmp_path / "damaged")
    run(out, resume=True)
    assert_same_run(out, whole)


@pytest.mark.parametrize(
    ("drop", "says"),
    [
        (lambda line: line.get("step") == 16 and line["seed"] == 5, "has 14 of 16 results up to step 48"),
        (lambda line: True, "has 0 of 16 results .* or move the folder away and give --resume, which trains these"),
    ],
)
def test_rows_that_were_lost_before_the_checkpoint_are_missed(stopped, tmp_path, drop, says):
    out = copied(stopped, tmp_path)
    table = out / "relative" / results.JSONL
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(line for line in lines if not drop(json.loads(line))))
    refused(out, says)


def test_a_finished_kind_is_looked_at_before_it_is_called_finished(whole, tmp_path):
    out = copied(whole, tmp_path)
    file = out / "relative" / results.PARQUET
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    refused(out, "is damaged: restore it")
    tables.write(file, tables.read(whole / "relative" / results.PARQUET, results.SCHEMA).slice(1))
    refused(out, "has 27 of 28 results")


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """A run of other settings, stopped where `stopped` was."""
    out = tmp_path_factory.mktemp("other") / "run"
    config = dataclasses.replace(CONFIG, scalars=dataclasses.replace(CONFIG.scalars, discount=0.4))
    with stopping_at(6 + 3), pytest.raises(Interrupted):
        train.run(Order(TASK, config, GRID, out))
    return out


@pytest.mark.parametrize("part", ["checkpoints", "results.jsonl", "guide.jsonl"])
def test_a_part_that_was_exchanged_with_another_runs_is_refused(stopped, other, tmp_path, part):
    out = copied(stopped, tmp_path)
    mine = out / "relative" / part
    if mine.is_dir():
        shutil.rmtree(mine)
        shutil.copytree(other / "relative" / part, mine)
        with pytest.raises(UserError, match="another run"):
            PolicySource.of_folder(out, lambda name: TASK).load()
    else:
        shutil.copy(other / "relative" / part, mine)
    refused(out, "another run")
