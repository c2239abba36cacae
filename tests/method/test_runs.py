"""A run's folder: what may be done to it, what it says of itself, and grids that make no sense."""

import json

import numpy as np
import probes
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.guidance import registry as guidances
from cuelearner_jax.runs import grid as runs
from cuelearner_jax.runs import sweep
from cuelearner_jax.runs.grid import Grid

TASK = probes.make_task()


def find(name):
    """The one task that is known here."""
    if name != TASK.name:
        raise UserError(f"unknown task {name!r}")
    return TASK


GRID = Grid(("none", "relative"), seeds=(4, 9), labels=(10, 15))


def described(config=probes.CONFIG, grid=GRID, split="tuning", task=TASK):
    return runs.describe(task, config, grid, split)


@pytest.fixture
def out(tmp_path):
    """The folder of an interrupted run."""
    folder = tmp_path / "run"
    runs.prepare_folder(folder, described(), clean=False)
    (folder / "none").mkdir()
    (folder / "none" / "results.jsonl").write_text("{}\n")
    return folder


def refused(folder, message, now=None, resume=False, overwrite=False):
    """`check_folder` refuses with `message` and changes nothing."""
    before = probes.files_of(folder.parent)
    with pytest.raises(UserError, match=message) as refusal:
        runs.check_folder(folder, described() if now is None else now, resume, overwrite)
    assert "\n" not in str(refusal.value)
    assert probes.files_of(folder.parent) == before


# What may be done to a folder.


def test_a_missing_or_empty_folder_may_be_used(tmp_path):
    runs.check_folder(tmp_path, described(), resume=False, overwrite=False)
    for overwrite in (False, True):
        runs.check_folder(tmp_path / "new", described(), resume=False, overwrite=overwrite)
    assert list(tmp_path.iterdir()) == []


def test_a_run_may_be_resumed_or_overwritten_and_nothing_else(out):
    refused(out, "not empty: give --resume to go on, --overwrite to delete it")
    runs.check_folder(out, described(), resume=True, overwrite=False)
    runs.check_folder(out, described(), resume=False, overwrite=True)
    refused(out, "give one of them", resume=True, overwrite=True)


def test_nothing_to_resume(tmp_path):
    refused(tmp_path / "new", "nothing to resume", resume=True)
    refused(tmp_path, "nothing to resume", resume=True)
    (tmp_path / "photo.txt").write_text("mine")
    refused(tmp_path, "nothing to resume", resume=True)


def test_overwriting_never_deletes_what_is_no_run(tmp_path):
    (tmp_path / "photo.txt").write_text("mine")
    refused(tmp_path, "not a run folder, so --overwrite will not delete it", overwrite=True)
    refused(tmp_path / "photo.txt", "not a run folder, so --overwrite will not delete it", overwrite=True)
    refused(tmp_path / "photo.txt", "not empty")


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("sizes.directions", described(probes.config(sizes={"directions": 32}))),
        ("sizes.q_layers", described(probes.config(sizes={"q_layers": (32,)}))),
        ("scalars.eps_deg", described(probes.config(scalars={"eps_deg": 6.0}))),
        ("schedule.guidance_until", described(probes.config(schedule={"guidance_until": 32}))),
        ("grid.seeds", described(grid=Grid(("none", "relative"), (4, 8), (10, 15)))),
        ("grid.labels", described(grid=Grid(("none", "relative"), (4, 9), (10,)))),
        ("grid.guidance", described(grid=Grid(("none",), (4, 9), (10, 15)))),
        ("split", described(split="validation")),
        ("task.name", described(task=probes.make_task("another"))),
        ("task.half_width_deg", {**described(), "task": {"name": "window", "half_width_deg": 5.0}}),
    ],
)
def test_resuming_with_another_option_names_it(out, name, other):
    refused(out, rf"was run with another {name}: give the same options", other, resume=True)


def test_resuming_names_several_options_and_those_that_only_one_side_has(out):
    other = described(probes.config(sizes={"directions": 32, "batch_size": 8}, scalars={"k_max": 3}))
    refused(out, r"another scalars\.k_max, sizes\.batch_size, sizes\.directions: give", other, resume=True)
    fewer = described()
    del fewer["scalars"]["k_max"]
    refused(out, r"another scalars\.k_max: give", fewer, resume=True)
    refused(out, r"another scalars\.more: give", {**described(), "scalars": {**described()["scalars"], "more": 1}},
            resume=True)  # fmt: skip


DAMAGED = [b"", b"{", b"\xff\xfe\x00", b"[]", b"3", b"null"]


@pytest.mark.parametrize("content", DAMAGED)
def test_resuming_from_a_damaged_description_is_refused(out, content):
    (out / "config.json").write_bytes(content)
    refused(out, r"config\.json is damaged: restore it or start anew with --overwrite", resume=True)
    runs.check_folder(out, described(), resume=False, overwrite=True)  # as the message says


# What it says of itself.


def test_a_run_comes_back_from_its_description(out):
    config = probes.config(sizes={"q_layers": (8, 4)}, scalars={"eps_deg": 7.5}, schedule={"random_steps": 4})
    runs.prepare_folder(out, described(config), clean=True)
    task, found, grid = runs.load(out, find)
    assert task is TASK
    assert found == config
    assert isinstance(found.sizes.q_layers, tuple)
    assert grid == GRID


def test_a_clean_start_deletes_the_run_and_any_other_keeps_it(out):
    runs.prepare_folder(out, described(split="validation"), clean=False)
    assert (out / "none" / "results.jsonl").exists()
    assert json.loads((out / "config.json").read_text())["split"] == "tuning"
    runs.prepare_folder(out, described(split="validation"), clean=True)
    assert [path.name for path in out.iterdir()] == ["config.json"]
    assert json.loads((out / "config.json").read_text())["split"] == "validation"


def test_a_folder_inside_folders_is_made(tmp_path):
    runs.prepare_folder(tmp_path / "a" / "b", described(), clean=True)
    assert runs.load(tmp_path / "a" / "b", find)[2] == GRID


def not_loaded(folder, message):
    before = probes.files_of(folder)
    with pytest.raises(UserError, match=message) as refusal:
        runs.load(folder, find)
    assert "\n" not in str(refusal.value)
    assert probes.files_of(folder) == before


def test_a_folder_that_is_no_run_is_not_loaded(tmp_path):
    not_loaded(tmp_path, "no run folder")
    not_loaded(tmp_path / "missing", "no run folder")


@pytest.mark.parametrize("content", DAMAGED)
def test_a_damaged_description_is_not_loaded(out, content):
    (out / "config.json").write_bytes(content)
    not_loaded(out, "damaged or of another program")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values.pop("grid"), "damaged or of another program"),
        (lambda values: values["grid"].pop("seeds"), "damaged or of another program"),
        (lambda values: values.update(grid=[1]), "damaged or of another program"),
        (lambda values: values["grid"].update(seeds=3), "damaged or of another program"),
        (lambda values: values.pop("schedule"), "damaged or of another program"),
        (lambda values: values.update(sizes=3), "damaged or of another program"),
        (lambda values: values["task"].pop("name"), "damaged or of another program"),
        (lambda values: values["task"].update(name="tennis"), "of a task that is not here .unknown task 'tennis'"),
        (lambda values: values["scalars"].update(colour=1), "unknown field 'colour' for Scalars"),
    ],
)
def test_the_description_of_another_program_is_not_loaded(out, change, message):
    probes.edit_json(out / "config.json", change)
    not_loaded(out, message)


def test_the_learned_teachers_description_is_no_run(out):
    (out / "config.json").write_text(json.dumps({"config": {"layers": [3]}, "task": {"name": "window"}, "seed": 0}))
    not_loaded(out, "damaged or of another program")


# Grids.


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        (Grid(("relativ",), (0,), (10,)), "unknown guidance 'relativ'"),
        (Grid((), (0,), (10,)), "give each kind once, and at least one"),
        (Grid(("none", "none"), (0,), (10,)), "give each kind once, and at least one"),
        (Grid(("none",), (), (10,)), "seeds must be different numbers"),
        (Grid(("none",), (3, 3), (10,)), "seeds must be different numbers"),
        (Grid(("none",), (-1,), (10,)), "seeds must be different numbers"),
        (Grid(("none",), (runs.LARGEST_SEED,), (10,)), "seeds must be different numbers"),
        (Grid(("relative",), (0,), ()), "--labels: give each budget once"),
        (Grid(("relative",), (0,), (10, 10)), "--labels: give each budget once"),
        (Grid(("relative",), (0,), (10, 0)), "a label budget of 0 teaches nothing"),
        (Grid(("relative",), (0,), (-5,)), "a label budget of -5 teaches nothing"),
    ],
)
def test_grids_that_make_no_sense_are_refused(grid, message, tmp_path):
    with pytest.raises(UserError, match=message):
        runs.check_grid(grid)
    with pytest.raises(UserError, match=message):
        sweep.run(TASK, probes.CONFIG, grid, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_grids_that_make_sense():
    runs.check_grid(GRID)
    runs.check_grid(Grid(("none", "heuristic"), (0, runs.LARGEST_SEED - 1), ()))
    runs.check_grid(Grid(("none",), (0,), (10, 10)))  # budgets that nobody uses


def test_lanes_are_seeds_times_budgets_and_one_a_seed_without_labels():
    relative, none = (guidances.make(kind, probes.SIZES, 2) for kind in ("relative", "none"))
    seeds, budgets = GRID.lanes(relative)
    assert list(zip(seeds.tolist(), budgets.tolist(), strict=True)) == [(4, 10), (9, 10), (4, 15), (9, 15)]
    seeds, budgets = GRID.lanes(none)
    assert list(zip(seeds.tolist(), budgets.tolist(), strict=True)) == [(4, 0), (9, 0)]
    assert seeds.dtype == budgets.dtype == np.int32


# The same through `sweep.run`: nothing is changed on disk by what is refused.


@pytest.mark.parametrize(
    ("config", "grid", "options", "message"),
    [
        (probes.CONFIG, GRID, {}, "not empty"),
        (probes.CONFIG, GRID, {"resume": True, "overwrite": True}, "give one of them"),
        (probes.config(scalars={"k_max": 3}), GRID, {"resume": True}, r"another scalars\.k_max"),
        (probes.config(sizes={"batch_size": 0}), GRID, {"overwrite": True}, r"sizes\.batch_size is 0"),
        (probes.CONFIG, Grid(("none",), (), ()), {"overwrite": True}, "seeds must be"),
        (probes.config(sizes={"replay_capacity": 10**12}), GRID, {"overwrite": True}, "are free"),
    ],
)
def test_a_refused_run_changes_nothing(out, config, grid, options, message):
    before = probes.files_of(out.parent)
    with pytest.raises(UserError, match=message):
        sweep.run(TASK, config, grid, out, split="tuning", **options)
    assert probes.files_of(out.parent) == before


def test_a_missing_teacher_is_said_before_anything_is_deleted(out):
    def no_teacher(config, env):
        raise UserError("no teacher")

    task = TASK.__class__(**{**TASK.__dict__, "teacher": no_teacher})
    before = probes.files_of(out.parent)
    with pytest.raises(UserError, match="no teacher"):
        sweep.run(task, probes.CONFIG, GRID, out, overwrite=True, split="tuning")
    assert probes.files_of(out.parent) == before
