"""Runs that were stopped or killed and resumed: bitwise the run that was left alone."""

import dataclasses
import json
import shutil
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import jax
import numpy as np
import probes
import pyarrow.parquet as pq
import pytest
from small_runs import stopping_at

from cuelearner_jax.arbiters import Paced
from cuelearner_jax.asking import label_slots
from cuelearner_jax.errors import UserError
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.loop import start_clock
from cuelearner_jax.runs import lane_checkpoints, lanes, runner, training
from cuelearner_jax.runs.grid import Grid, run_key
from cuelearner_jax.runs.lane_checkpoints import items
from cuelearner_jax.runs.order import Order
from cuelearner_jax.runs.program import make_program
from cuelearner_jax.runs.trained import PolicySource
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.storage import formats, label_files, results
from cuelearner_jax.storage import table as tables
from cuelearner_jax.storage.checkpoint import Checkpoints
from cuelearner_jax.storage.folders import prepare_folder
from cuelearner_jax.studies import train
from cuelearner_jax.terminal import Interrupted

# Bootstraps and is paced, so that target network, next observations, Adam's moments and what each arm has earned are in
# the checkpoint as well.
SMALL = {"feedback_layers": (16,), "lanes_per_block": 2, "fit_steps": 100}
SMALL_AGENT = {"q_layers": (16,), "replay_capacity": 40}
CONFIG = probes.config(
    sizes=SMALL,
    scalars={"discount": 0.5, "silence_probability": 0.05},
    agent=SMALL_AGENT,
    arbiter=Paced(lead=0.0),
    schedule={"total_steps": 96, "guidance_until": 64, "eval_every": 16, "checkpoint_every": 32},
)
GRID = Grid(("relative", "none"), seeds=(3, 5), labels=(35, 60))  # 6 rounds; 4 lanes in 2 blocks of 2
TASK = probes.make_task()
VOLATILE = ("wall_s", "commit", "command", "folder")


class Killed(Exception):
    """Stands for a kill: nothing that comes after it in the program runs."""


@pytest.fixture(autouse=True, scope="module")
def compiled_once():
    """Every run makes the same programs: compile them once. And two rounds of labels between checkpoints."""
    programs = {}

    def made(config, guidance, env, largest_budget, mesh=None, lanes=1):
        known = (config.sizes, config.bootstraps, guidance, label_slots(largest_budget, config.sizes))
        if known not in programs:
            programs[known] = make_program(config, guidance, env, largest_budget, mesh, lanes)
        return programs[known]

    def committed(make):
        # As arrays from a checkpoint are: JAX compiles separately for those that are tied to no device.
        return lambda *arguments: jax.device_put(make(*arguments), jax.devices()[0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lanes.LaneGroup, "start", committed(lanes.LaneGroup.start))
        patch.setattr(training, "start_clock", committed(start_clock))
        patch.setattr(lanes, "make_program", made)
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
    like = items(group.shapes_of(group.cut), jax.eval_shape(start_clock), 0.0)
    key = run_key(formats.read("config", out / "config.json"), kind)
    with Checkpoints(out / kind / "checkpoints", read_only=True, run=key) as saved:
        found = saved.restore(like)
        del found["clock"]["wall_s"]
        return found, saved.latest()


def rows(out, but=()):
    table = results.read(out)
    return table.drop_columns([name for name in (*VOLATILE, *but) if name in table.column_names]).to_pylist()


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
    with stopping_at(6 + 3), pytest.raises(Interrupted):
        run(out)
    return out


def copied(folder, tmp_path):
    return Path(shutil.copytree(folder, tmp_path / "copy" / "run"))


@cache
def kept_by(whole):
    """Each kind's newest checkpoint of a run that nobody changes."""
    return {kind: newest(whole, kind) for kind in GRID.guidance}


def assert_same_run(out, whole, but=()):
    for kind in GRID.guidance:
        (mine, number), (expected, last) = newest(out, kind), kept_by(whole)[kind]
        assert number == last
        assert jax.tree.structure(mine) == jax.tree.structure(expected)
        for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(expected), strict=True):
            assert one.dtype == other.dtype
            assert np.asarray(probes.words(one)).tobytes() == np.asarray(probes.words(other)).tobytes()
        assert not (out / kind / results.JSONL).exists()
    assert rows(out, but) == rows(whole, but)
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
    state, number = kept_by(whole)["relative"]
    assert number == 6 + 96
    assert state["rest"][0].agent.training.target_params is not None
    assert (state["rest"][0].arbiter.sums.episodes > 0).all()
    assert len({row["train_guided_share"] for row in table if row["guidance"] == "relative" and row["step"] == 48}) > 1
    assert all(row["train_guided_share"] == 0 for row in table if row["guidance"] == "none" and row["step"])
    assert int(state["clock"]["clock"].update) == 96


def test_a_checkpoint_whose_lanes_had_another_state_is_refused(whole, tmp_path, monkeypatch):
    out = shutil.copytree(whole, tmp_path / "run")
    (out / "none" / results.PARQUET).unlink()
    before = probes.files_of(out)
    of_now = lane_checkpoints.items

    def of_a_newer_program(blocks, clock, wall):
        made = of_now(blocks, clock, wall)
        return {**made, "rest": [block.replace(arbiter=(block.arbiter, block.failed)) for block in made["rest"]]}

    monkeypatch.setattr(lane_checkpoints, "items", of_a_newer_program)
    with pytest.raises(UserError, match="of another configuration or version of the program, use that one") as told:
        run(out, resume=True)
    assert "\n" not in str(told.value)
    assert probes.files_of(out) == before


@pytest.mark.long
def test_the_same_command_gives_the_same_run(whole, tmp_path):
    run(tmp_path / "run")
    assert_same_run(tmp_path / "run", whole)


@pytest.mark.long
def test_stopped_and_killed_while_labelling(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(3), pytest.raises(Interrupted, match="--resume"):
        run(out)
    assert newest(out, "relative")[1] == 3
    # Round 4 is saved, round 5 is asked, then the process dies.
    with killed_at(2, "_stop_if_asked"), pytest.raises(Killed):
        run(out, resume=True)
    assert newest(out, "relative")[1] == 4
    assert not (out / "relative" / "labels.parquet").exists()
    run(out, resume=True)
    assert_same_run(out, whole)


def test_stopped_and_killed_while_training(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(6 + 3), pytest.raises(Interrupted, match="step 48 of relative"):
        run(out)
    assert newest(out, "relative")[1] == 6 + 48
    # The row of step 80 is on disk, its checkpoint (at 64) is not the newest state.
    with killed_at(2, "_stop_if_asked"), pytest.raises(Killed):
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


ENDS = {
    "killed before anything was saved": lambda: killed_at(1, "_label"),
    "stopped in the last round of labels": lambda: stopping_at(6),
    "stopped after the last step": lambda: stopping_at(6 + 6),
}


@pytest.mark.long
@pytest.mark.parametrize("end", ENDS)
def test_a_run_that_was_cut_short_goes_on_as_one(whole, tmp_path, end):
    out = tmp_path / "run"
    with ENDS[end](), pytest.raises((Killed, Interrupted)):
        run(out)
    run(out, resume=True)
    assert_same_run(out, whole)


@pytest.mark.long
def test_killed_between_the_labels_and_the_first_row(whole, tmp_path):
    out = tmp_path / "run"
    with killed_at(1, "_train"), pytest.raises(Killed):
        run(out)
    with killed_at(1, "_stop_if_asked"), pytest.raises(Killed):
        run(out, resume=True)
    assert {row["step"] for row in rows(out)} == {0, 16}
    run(out, resume=True)
    assert_same_run(out, whole)


def test_resuming_a_finished_run_changes_nothing(whole):
    before = probes.files_of(whole)
    run(whole, resume=True)
    assert probes.files_of(whole) == before


def torn_row(out):
    (out / "relative" / results.JSONL).write_text((out / "relative" / results.JSONL).read_text() + '{"step": 48, "se')


def damaged_labels(out):
    (out / "relative" / label_files.PARQUET).write_bytes(b"PAR1")


@pytest.mark.long
@pytest.mark.parametrize("damage", [torn_row, damaged_labels])
def test_what_a_kill_can_tear_is_written_anew(stopped, whole, tmp_path, damage):
    out = copied(stopped, tmp_path)
    damage(out)
    run(out, resume=True)
    assert_same_run(out, whole)


def test_a_block_filled_up_with_repeats_has_a_row_for_each_seed(whole, tmp_path):
    out = tmp_path / "run"
    train.run(Order(TASK, CONFIG, Grid(("none",), (3, 5, 7), ()), out))  # blocks of 3, 5 and of 7, 7
    table = rows(out)
    assert [row["seed"] for row in table if row["step"] == 96] == [3, 5, 7]
    expected = [row for row in rows(whole) if row["guidance"] == "none"]
    assert [row for row in table if row["seed"] != 7] == expected


# Labels from a file.


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

    task = probes.make_task()
    object.__setattr__(task, "teacher", refuse)
    with stopping_at(2), pytest.raises(Interrupted):
        train.run(Order(task, CONFIG, grid, out, labels_from=path))
    train.run(Order(task, CONFIG, grid, out, labels_from=path, resume=True))
    state, _ = newest(out, "relative", grid)
    labels = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(block.guide.labels for block in state["rest"]))
    for lane, (seed, budget) in enumerate([(1, 35), (0, 35), (1, 60), (0, 60)]):
        np.testing.assert_array_equal(labels.valid[lane], np.arange(60) < budget)
        for name in ("obs", "action", "answer"):
            np.testing.assert_array_equal(getattr(labels, name)[lane, :budget], getattr(given, name)[seed, :budget])
    assert all(bool(block["guidance"].fitted.all()) for block in state["policy"])
    copied = label_files.read(out / "relative" / "labels.parquet")
    assert copied.seeds.tolist() == [5] * 60 + [3] * 60
    np.testing.assert_array_equal(copied.labels.answer, np.concatenate([answer[1], answer[0]]))


def test_the_labels_that_a_run_wrote_give_its_guidance_again(whole, tmp_path):
    # Silent answers are not written, so budgets are of what was answered.
    written = label_files.read(whole / "relative" / "labels.parquet")
    counts = [int((written.seeds == seed).sum()) for seed in GRID.seeds]
    assert all(50 < count < 60 for count in counts)
    grid = Grid(("relative",), GRID.seeds, (min(counts),))
    train.run(Order(TASK, CONFIG, grid, tmp_path / "run", labels_from=whole / "relative" / "labels.parquet"))
    again = label_files.read(tmp_path / "run" / "relative" / "labels.parquet")
    for seed in GRID.seeds:
        mine, theirs = (file.labels.obs[file.seeds == seed][: min(counts)] for file in (again, written))
        np.testing.assert_array_equal(mine, theirs)


def test_a_damaged_checkpoint_is_refused_and_the_one_before_serves(stopped, whole, tmp_path):
    out = copied(stopped, tmp_path)
    newest_folder = out / "relative" / "checkpoints" / str(6 + 48)
    for path in (newest_folder / "rest").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.raises(UserError, match="cannot be read"):
        run(out, resume=True)
    newest_folder.rename(tmp_path / "damaged")
    run(out, resume=True)
    assert_same_run(out, whole)


# What is lost or changed is said before anything goes on.


def without_rows(table, drop):
    """Rewrites a growing table without some rows."""
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(line for line in lines if not drop(json.loads(line))))


def refused(out, message):
    before = probes.files_of(out)
    with pytest.raises(UserError, match=message) as refusal:
        run(out, resume=True)
    assert "\n" not in str(refusal.value)
    assert probes.files_of(out) == before


@pytest.mark.parametrize(
    ("drop", "says"),
    [
        (lambda line: line.get("step") == 16 and line["seed"] == 5, "has 14 of 16 results up to step 48"),
        (lambda line: line.get("step", 0) > 16, "has 8 of 16 results up to step 48"),
        (lambda line: "step" in line, "has 0 of 16 results up to step 48"),
    ],
)
def test_rows_that_were_lost_before_the_checkpoint_are_missed(stopped, tmp_path, drop, says):
    out = copied(stopped, tmp_path)
    without_rows(out / "relative" / results.JSONL, drop)
    refused(out, says)


@pytest.mark.long
def test_a_table_that_was_lost_is_missed_and_its_lanes_can_be_trained_anew(stopped, whole, tmp_path):
    out = copied(stopped, tmp_path)
    (out / "relative" / results.JSONL).unlink()
    refused(out, "relative has 0 of .* or move the folder away and give --resume, which trains these lanes anew")
    shutil.rmtree(out / "relative")  # as the message says
    run(out, resume=True)
    assert_same_run(out, whole)


def test_a_finished_kind_is_looked_at_before_it_is_called_finished(whole, tmp_path):
    out = copied(whole, tmp_path)
    file = out / "relative" / results.PARQUET
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    refused(out, "is damaged: restore it")
    tables.write(file, pq.read_table(whole / "relative" / results.PARQUET).slice(1), results.SCHEMA)
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


@pytest.mark.parametrize(("resume", "says"), [(False, "not empty"), (True, "other values of scalars.eps_deg")])
def test_a_folder_that_another_process_used_in_the_meantime_is_left_alone(stopped, tmp_path, resume, says):
    out, other = copied(stopped, tmp_path), tmp_path / "other"
    if resume:
        prepare_folder(other, formats.read("config", out / "config.json"), clean=True)

    @contextmanager
    def late(folder):
        """The folder becomes another run's between the first look and the lock."""
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(out, folder)
        probes.edit_json(folder / "config.json", lambda values: values["scalars"].update(eps_deg=1.0))
        yield

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "claimed", late)
        with pytest.raises(UserError, match=says):
            run(other, resume=resume)
    assert formats.read("config", other / "config.json")["scalars"]["eps_deg"] == 1.0
    assert read_labels(other)[0].shape == read_labels(out)[0].shape
