"""Gymnasium's environments on the command line: trained, resumed, adapted, drawn, and never imported by a file."""

import json
import shutil

import numpy as np
import probes
import pytest
from small_runs import next_command, stopping_at

import cuelearner_jax as cl
from cuelearner_jax.bridges.gymnasium import pool
from cuelearner_jax.cli import main
from cuelearner_jax.cli.options import look_ahead
from cuelearner_jax.cli.sources import source_of
from cuelearner_jax.config import to_json
from cuelearner_jax.storage import label_files, results

REACH = "gymnasium:gymnasium_worlds:reach"
TINY = [
    *("--agent.q-layers", "8", "--agent.directions", "8", "--agent.target-directions", "8", "--agent.batch-size", "8"),
    *("--agent.replay-capacity", "80", "--sizes.num-envs", "4", "--schedule.eval-every", "40"),
    *("--schedule.total-steps", "80", "--schedule.random-steps", "8", "--schedule.learn-after", "8"),
    *("--schedule.guidance-until", "80", "--schedule.checkpoint-every", "40", "--schedule.eval-envs", "4"),
    *("--schedule.eval-steps", "48", "--task.processes", "1", "--guidance", "none"),
]
SMALL = [
    *("--sizes.feedback-layers", "8", "8", "--sizes.fit-steps", "40", "--sizes.labels-per-round", "10"),
    *("--sizes.fit-batch-size", "16", "--judge-episodes", "4", "--task.processes", "1"),
]


@pytest.fixture(autouse=True)
def closed():
    yield
    pool.close_all()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run."""
    out = tmp_path_factory.mktemp("gymnasium") / "run"
    assert main(["train", REACH, *TINY, "--out", str(out)]) == 0
    return out


def test_a_run_is_opened_without_its_environment_and_played_where_its_code_is_named(run, refused, capsys):
    described = json.loads((run / "config.json").read_text())["task"]
    assert (described["name"], described["environment"]) == ("gymnasium", "gymnasium_worlds:reach")
    policy = cl.load_policy(run)  # nothing is imported for it
    assert policy(np.zeros(6)).shape == (3,)
    refused(["evaluate", run, "--episodes", "4"], f"a file names it: name it again, by --env {REACH} or", run)
    assert main(["evaluate", str(run), "--env", REACH, "--episodes", "4", "--task.processes", "1"]) == 0
    assert "success" in capsys.readouterr().out


def test_the_layout_is_that_of_the_given_arguments():
    larger = look_ahead(["gymnasium:FrozenLake-v1", "--task.arguments", '{"map_name": "8x8"}'])
    assert source_of(larger).config.task.slice_sizes == (64,)


def test_a_file_may_not_have_an_id_import_code(run, refused, tmp_path):
    for name in ("os:system", "gymnasium_worlds:Reach-v0"):
        folder = tmp_path / name.replace(":", "-")
        folder.mkdir()
        shutil.copy(run / "config.json", folder)
        probes.edit_json(folder / "config.json", lambda told, name=name: told["task"].update(environment=name))
        refused(
            ["evaluate", folder, "--policy", "uniform", "--episodes", "2"],
            "not imported because a file names it",
            folder,
        )


@pytest.mark.long
def test_an_interrupted_training_goes_on_bitwise(run, tmp_path):
    half = tmp_path / "half"
    command = ["train", REACH, *TINY, "--out", str(half)]
    with stopping_at(1):
        assert main(command) == 130
    pool.close_all()  # nothing is left of the instances
    assert main([*command, "--resume"]) == 0
    whole, resumed = (results.read(folder).to_pylist() for folder in (run, half))
    assert len(whole) == len(resumed)
    for before, after in zip(whole, resumed, strict=True):
        assert {name for name in before if before[name] != after[name]} <= APART


APART = {"wall_s", "commit", "command", "folder", "run"}


def test_code_is_adapted_by_code_that_teaches(tmp_path, capsys):
    out, world = tmp_path / "better", ["--env", "gymnasium:gymnasium_worlds:ReachByName-v0"]
    command = ["adapt", "gymnasium_worlds:beside", *world, "--teacher", "gymnasium_worlds:toward"]
    layout = ["--task.slices", "hand", "goal", "--task.slice-sizes", "3", "3", "--task.units", "1", "m"]
    layout += ["--task.slice-kinds", "", ""]
    assert main([*command, "--guidance", "relative", "--labels", "20", *SMALL, *layout, "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "success on tuning episodes" in told  # where there is one, success judges
    again = next_command(told)
    source = source_of(look_ahead(again[1:]))
    assert (source.config.task.slices, source.config.task.processes) == (("hand", "goal"), 1)  # the folder's own
    assert main([*again, "--episodes", "4"]) == 0
    for steps, words in ((5, "a,b"), (12, "left,right")):  # labels about this world, with words for its cues
        there, rows = cl.make(world[1], max_steps=steps, cues=(words, "c,d", "e,f")), np.zeros((1, steps, 6), "f4")
        labels = probes.label_set(rows, rows[..., :3], rows[..., :3], np.ones((1, steps), bool))
        about = {"name": "gymnasium", **to_json(there.config)}, "relative", there.actions, 1 / 36, np.zeros(1)
        label_files.write(tmp_path / f"{steps}.parquet", *about, labels)
    files = [str(tmp_path / f"{name}.parquet") for name in (5, 12, "both")]
    assert main(["labels", "merge", *files[:2], "--out", files[2]]) == 0
    options = ["--guidance", "relative", "--judge-by", "labels", "--labels-from", files[2], *SMALL]
    assert main([*command[:4], *options, "--out", str(tmp_path / "given")]) == 0


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (["evaluate", "gymnasium"], "gymnasium is a family of tasks: name one of its environments, as gymnasium:NAME"),
        (["render", REACH, "--policy", "uniform", "--out", "film.gif"], "cannot be drawn"),
        (["adapt", "gymnasium_worlds:beside", "--teacher", "gymnasium_worlds:toward"], "--env gymnasium:NAME"),
        (["adapt", "model.zip", "--env", REACH], "and give my_policy:POLICY (module:NAME"),
        (["adapt", "./mine.py:policy", "--env", REACH], "give package.module:NAME, for instance my_code:MINE"),
    ],
)
def test_wrong_commands_are_refused_in_one_line(command, says, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(command, says, tmp_path)


def test_a_policy_of_another_layout_is_refused(run, refused):
    says = "observes 6 entries, this world has 4: give the world that it was made for"
    refused(["evaluate", run, "--env", "gymnasium:CartPole-v1"], says, run)
    says = "gives actions between (-1, -1, -1) and (1, 1, 1), this world takes actions between (-2, -1, -1)"
    refused(["evaluate", run, "--task.low", "-2", "-1", "-1"], says, run)
