"""Runs that were stopped or killed and resumed: bitwise the run that was left alone."""

import json
import threading
from contextlib import contextmanager

import jax
import numpy as np
import probes
import pytest

from cuelearner_jax import guidance as guidances
from cuelearner_jax import lanes, results, sweep
from cuelearner_jax.checkpoint import checkpoints
from cuelearner_jax.errors import UserError
from cuelearner_jax.labelling import files as label_files
from cuelearner_jax.runs import Grid
from cuelearner_jax.train import start_clock

# Bootstraps, so that target network, next observations and Adam's moments are in the checkpoint as well.
CONFIG = probes.config(
    sizes={"lanes_per_block": 3, "fit_steps": 100, "replay_capacity": 40},
    scalars={"discount": 0.5, "silence_probability": 0.2},
    schedule={"total_steps": 96, "guidance_until": 64, "eval_every": 16, "checkpoint_every": 32},
)
GRID = Grid(("relative", "none"), seeds=(3, 5), labels=(35, 60))  # 6 rounds; 4 lanes in 2 blocks of 2
TASK = probes.make_task()
VOLATILE = ("wall_s", "commit", "command", "folder")


class Killed(Exception):
    """Stands for a kill: nothing that comes after it in the program runs."""


@pytest.fixture(autouse=True)
def two_rounds_between_checkpoints(monkeypatch):
    monkeypatch.setattr(sweep, "ROUNDS_A_CHUNK", 2)


@contextmanager
def stopping_at(when):
    """Ctrl-C at the given look at the event (each round of labels and each stretch of steps looks once)."""

    class Event(threading.Event):
        looks = 0

        def is_set(self):
            Event.looks += 1
            return Event.looks == when

    @contextmanager
    def interruptible():
        yield Event()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep, "interruptible", interruptible)
        yield


@contextmanager
def killed_at(when, method):
    """A kill in place of the given call of a method of the runner."""
    calls = 0
    usual = getattr(sweep._Runner, method)

    def counted(self, *arguments):
        nonlocal calls
        calls += 1
        if calls == when:
            raise Killed
        return usual(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep._Runner, method, counted)
        yield


def run(out, **options):
    sweep.run(TASK, CONFIG, GRID, out, **options)


def newest(out, kind, grid=GRID):
    """The newest checkpoint's arrays and number."""
    group = lanes.Group(CONFIG, TASK.environment(CONFIG.task), guidances.make(kind, CONFIG.sizes, 2), grid)
    like = lanes.items(group.shapes(), jax.eval_shape(start_clock), 0.0)
    with checkpoints(out / kind / "checkpoints", read_only=True) as saved:
        found = saved.restore(like)
        del found["clock"]["wall_s"]
        return found, saved.latest()


def rows(out):
    table = results.read(out)
    return table.drop_columns([name for name in VOLATILE if name in table.column_names]).to_pylist()


def read_labels(out):
    file = label_files.read(out / "relative" / "labels.parquet")
    return [file.seeds, file.labels.obs, file.labels.action, file.labels.target]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep, "ROUNDS_A_CHUNK", 2)
        run(out)
    return out


def assert_same_run(out, whole):
    for kind in GRID.guidance:
        (mine, number), (expected, last) = newest(out, kind), newest(whole, kind)
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
    state, number = newest(whole, "relative")
    assert number == 6 + 96
    assert state["rest"][0].target_params is not None
    assert int(state["clock"]["clock"].update) == 96


def test_the_same_command_gives_the_same_run(whole, tmp_path):
    run(tmp_path / "run")
    assert_same_run(tmp_path / "run", whole)


def test_stopped_and_killed_while_labelling(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(3), pytest.raises(sweep.Interrupted, match="--resume"):
        run(out)
    assert newest(out, "relative")[1] == 3
    # Round 4 is saved, round 5 is asked, then the process dies.
    with killed_at(3, "_stop_if_asked"), pytest.raises(Killed):
        run(out, resume=True)
    assert newest(out, "relative")[1] == 4
    assert not (out / "relative" / "labels.parquet").exists()
    run(out, resume=True)
    assert_same_run(out, whole)


def test_stopped_and_killed_while_training(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(6 + 3), pytest.raises(sweep.Interrupted, match="step 48 of relative"):
        run(out)
    assert newest(out, "relative")[1] == 6 + 48
    # The row of step 80 is on disk, its checkpoint (at 64) is not the newest state.
    with killed_at(2, "_stop_if_asked"), pytest.raises(Killed):
        run(out, resume=True)
    assert newest(out, "relative")[1] == 6 + 64
    assert max(row["step"] for row in rows(out)) == 80
    # And once more in the other kind, after the row and before the checkpoint of its first saved step.
    with killed_at(2 + 1 + 1, "_save"), pytest.raises(Killed):
        run(out, resume=True)
    assert (out / "relative" / results.PARQUET).exists()
    assert max(row["step"] for row in rows(out) if row["guidance"] == "none") in (32, 64)
    run(out, resume=True)
    assert_same_run(out, whole)


def test_killed_before_anything_was_saved(whole, tmp_path):
    out = tmp_path / "run"
    with killed_at(1, "_label"), pytest.raises(Killed):
        run(out)
    run(out, resume=True)
    assert_same_run(out, whole)


def test_killed_between_the_labels_and_the_first_row(whole, tmp_path):
    out = tmp_path / "run"
    with killed_at(1, "_train"), pytest.raises(Killed):
        run(out)
    with killed_at(1, "_stop_if_asked"), pytest.raises(Killed):
        run(out, resume=True)
    assert {row["step"] for row in rows(out)} == {0, 16}
    run(out, resume=True)
    assert_same_run(out, whole)


def test_stopped_in_the_last_round_of_labels(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(6), pytest.raises(sweep.Interrupted):
        run(out)
    run(out, resume=True)
    assert_same_run(out, whole)


def test_stopped_after_the_last_step(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(6 + 6), pytest.raises(sweep.Interrupted):
        run(out)
    run(out, resume=True)
    assert_same_run(out, whole)


def test_resuming_a_finished_run_changes_nothing(whole):
    before = probes.files_of(whole)
    run(whole, resume=True)
    assert probes.files_of(whole) == before


def test_a_torn_last_row_is_written_anew(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(6 + 3), pytest.raises(sweep.Interrupted):
        run(out)
    with (out / "relative" / results.JSONL).open("a") as file:
        file.write('{"step": 48, "se')
    run(out, resume=True)
    assert_same_run(out, whole)


def test_blocks_of_lanes_have_no_influence(whole, tmp_path):
    out = tmp_path / "run"
    sweep.run(TASK, probes.config(**(OTHER_BLOCKS)), GRID, out)
    for mine, expected in zip(rows(out), rows(whole), strict=True):
        for name in mine.keys() - {"config_hash"}:
            assert mine[name] == (pytest.approx(expected[name], abs=1e-3) if name in METRICS else expected[name])


OTHER_BLOCKS = {
    "sizes": {"lanes_per_block": 4, "fit_steps": 100, "replay_capacity": 40},
    "scalars": {"discount": 0.5, "silence_probability": 0.2},
    "schedule": {"total_steps": 96, "guidance_until": 64, "eval_every": 16, "checkpoint_every": 32},
}
METRICS = ("reward", "hit", "guide_reward", "train_reward", "train_loss", "train_passes")


# Labels from a file.


def test_labels_of_a_file_are_used_exactly(tmp_path):
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, (2, 2, 60))
    obs, action = np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)
    target = rng.normal(scale=0.1, size=(2, 60, 2)).astype(np.float32)
    given = label_files.Label(obs, action, target, np.ones((2, 60), bool))
    path = tmp_path / "given.parquet"
    label_files.write(path, {"name": "window"}, "relative", np.array([3, 5]), given)
    grid = Grid(("relative",), seeds=(5, 3), labels=(35, 60))
    out = tmp_path / "run"

    def refuse(config, env):
        raise AssertionError("a teacher was made although the labels are given")

    task = probes.make_task()
    object.__setattr__(task, "teacher", refuse)
    with stopping_at(2), pytest.raises(sweep.Interrupted):
        sweep.run(task, CONFIG, grid, out, labels_from=path)
    sweep.run(task, CONFIG, grid, out, labels_from=path, resume=True)
    state, _ = newest(out, "relative", grid)
    labels = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(block.asking.labels for block in state["rest"]))
    for lane, (seed, budget) in enumerate([(1, 35), (0, 35), (1, 60), (0, 60)]):
        np.testing.assert_array_equal(labels.valid[lane], np.arange(60) < budget)
        for name in ("obs", "action", "target"):
            np.testing.assert_array_equal(getattr(labels, name)[lane, :budget], getattr(given, name)[seed, :budget])
    assert all(bool(block["guidance"].fitted.all()) for block in state["policy"])
    copied = label_files.read(out / "relative" / "labels.parquet")
    assert copied.seeds.tolist() == [5] * 60 + [3] * 60
    np.testing.assert_array_equal(copied.labels.target, np.concatenate([target[1], target[0]]))


def test_the_labels_that_a_run_wrote_give_its_guidance_again(whole, tmp_path):
    # Silent answers are not written, so budgets are of what was answered.
    written = label_files.read(whole / "relative" / "labels.parquet")
    counts = [int((written.seeds == seed).sum()) for seed in GRID.seeds]
    assert all(30 < count < 60 for count in counts)
    grid = Grid(("relative",), GRID.seeds, (min(counts),))
    sweep.run(TASK, CONFIG, grid, tmp_path / "run", labels_from=whole / "relative" / "labels.parquet")
    again = label_files.read(tmp_path / "run" / "relative" / "labels.parquet")
    for seed in GRID.seeds:
        mine, theirs = (file.labels.obs[file.seeds == seed][: min(counts)] for file in (again, written))
        np.testing.assert_array_equal(mine, theirs)


# Folders that are refused, with nothing changed on disk.


def refused(out, match, config=CONFIG, grid=GRID, **options):
    before = probes.files_of(out) if out.exists() else None
    with pytest.raises(UserError, match=match) as refusal:
        sweep.run(TASK, config, grid, out, **options)
    assert "\n" not in str(refusal.value)
    assert (probes.files_of(out) if out.exists() else None) == before


def test_a_folder_in_use_is_refused(whole, tmp_path):
    refused(whole, "is not empty")
    (tmp_path / "notes.txt").write_text("mine")
    refused(tmp_path, "is not empty")
    refused(tmp_path / "notes.txt", "is not empty")


def test_overwrite_refuses_what_is_no_run(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    refused(tmp_path, "not a run folder", overwrite=True)


def test_resume_of_nothing_is_refused(tmp_path):
    refused(tmp_path / "never", "nothing to resume", resume=True)
    refused(tmp_path, "nothing to resume", resume=True)


def test_resume_and_overwrite_contradict_each_other(whole):
    refused(whole, "give one of them", resume=True, overwrite=True)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"scalars": {"eps_deg": 7.0}}, "scalars.eps_deg"),
        ({"sizes": {"directions": 32}}, "sizes.directions"),
        ({"schedule": {"guidance_until": 60}}, "schedule.guidance_until"),
    ],
)
def test_resume_with_other_options_names_them(whole, change, named):
    values = {group: OTHER_BLOCKS[group] | change.get(group, {}) for group in OTHER_BLOCKS}
    values["sizes"] = values["sizes"] | {"lanes_per_block": 3}
    refused(whole, f"with another {named}: give the same", config=probes.config(**values), resume=True)


def test_resume_with_another_grid_or_task_names_it(whole):
    refused(whole, "with another grid.seeds:", grid=Grid(GRID.guidance, (3, 5, 7), GRID.labels), resume=True)
    refused(whole, "with another grid.labels:", grid=Grid(GRID.guidance, GRID.seeds, (35,)), resume=True)
    refused(whole, "with another split:", split="tuning", resume=True)
    before = probes.files_of(whole)
    with pytest.raises(UserError, match=r"with another task\.name:"):
        sweep.run(probes.make_task("door"), CONFIG, GRID, whole, resume=True)
    assert probes.files_of(whole) == before


def test_a_damaged_configuration_is_refused(tmp_path):
    (tmp_path / "config.json").write_text("{")
    refused(tmp_path, "is damaged", resume=True)
    (tmp_path / "config.json").write_text("[1]")
    refused(tmp_path, "is damaged", resume=True)


def test_overwrite_starts_anew_what_is_a_run(tmp_path):
    out = tmp_path / "run"
    with stopping_at(1), pytest.raises(sweep.Interrupted):
        run(out)
    (out / "stray.txt").write_text("old")
    with stopping_at(1), pytest.raises(sweep.Interrupted):
        run(out, overwrite=True)
    assert not (out / "stray.txt").exists()
    assert newest(out, "relative")[1] == 1


def test_what_cannot_work_is_refused_before_anything_is_made(tmp_path):
    out = tmp_path / "run"
    refused(out, "scalars.eps_deg", config=probes.config(scalars={"eps_deg": 0.0}))
    refused(out, "different numbers", grid=Grid(("none",), (1, 1), (10,)))
    refused(out, "different numbers", grid=Grid(("none",), (-1,), (10,)))
    refused(out, "at least one", grid=Grid((), (1,), (10,)))
    refused(out, "each kind once", grid=Grid(("none", "none"), (1,), (10,)))
    refused(out, "telepathy", grid=Grid(("telepathy",), (1,), (10,)))
    refused(out, "each budget once", grid=Grid(("relative",), (1,), (10, 10)))
    refused(out, "teaches nothing", grid=Grid(("relative",), (1,), (0, 10)))
    refused(out, "no label file", labels_from=tmp_path / "none.parquet")
    assert not out.exists()


def test_more_memory_than_there_is_is_refused(tmp_path):
    out = tmp_path / "run"
    refused(out, "lower --sizes.replay-capacity", config=probes.config(sizes={"replay_capacity": 10**12}))
    assert not out.exists()


def test_memory_is_reported_for_what_fits():
    group = lanes.Group(CONFIG, TASK.environment(CONFIG.task), guidances.make("none", CONFIG.sizes, 2), GRID)
    line = lanes.memory_report(group)
    assert line.startswith("none: 2 lanes")
    assert lanes.state_bytes(group.shapes()) == lanes.state_bytes(group.start())


def test_a_damaged_checkpoint_is_refused_and_the_one_before_serves(whole, tmp_path):
    out = tmp_path / "run"
    with stopping_at(6 + 3), pytest.raises(sweep.Interrupted):
        run(out)
    newest_folder = out / "relative" / "checkpoints" / str(6 + 48)
    for path in (newest_folder / "rest").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.raises(UserError, match="cannot be read"):
        run(out, resume=True)
    newest_folder.rename(tmp_path / "damaged")
    run(out, resume=True)
    assert_same_run(out, whole)


def test_what_was_saved_can_be_traced(whole):
    values = json.loads((whole / "config.json").read_text())
    assert values["task"] == {"name": "window", "half_width_deg": 28.0}
    assert values["grid"] == {"guidance": ["relative", "none"], "seeds": [3, 5], "labels": [35, 60]}
    assert values["scalars"]["silence_probability"] == 0.2
