"""A task of the user's own, in a file beside: trained, evaluated, and never loaded because a run folder names it."""

import json
import sys

import pytest

from cuelearner_jax.cli import main
from cuelearner_jax.storage import results
from cuelearner_jax.tasks import registry

NAME = "own_window"
OWN = """
import dataclasses
import jax.numpy as jnp
from probes import CONFIG, make_task
from cuelearner_jax.task import Preset, Scenario

TASK = dataclasses.replace(
    make_task(),
    presets={"small": Preset("seconds", CONFIG, labels=(10,))},
    scenarios={"narrow": Scenario("a narrow window", {"half_width_deg": 5.0})},
)
MUTE = dataclasses.replace(TASK, name="mute", teacher=None)


def ahead(obs):
    return jnp.tile(jnp.array([[1.0, 0.0]]), (len(obs), 1))
"""
EVALUATE = ["--policy", "uniform", "--steps", "20", "--envs", "10"]


pytestmark = pytest.mark.usefixtures("there")


@pytest.fixture
def run(home, forget):
    """A finished run of the task."""
    out = home / "run"
    if not out.exists():
        assert main(["train", "own_window:TASK", "--guidance", "none", "--out", str(out)]) == 0
        forget()
    return out


def test_a_run_says_where_its_task_is_from(run):
    described = json.loads((run / "config.json").read_text())
    assert described["task"] == {"name": "window", "from": "own_window:TASK", "half_width_deg": 28.0}
    assert results.read(run).to_pylist()[0]["task"] == "window"


def test_a_file_does_not_have_code_loaded(run, refused, tmp_path):
    for command in ("evaluate", "render"):
        says = "not loaded just because a file names it: add --task own_window:TASK if you trust that code"
        refused([command, run, *(["--out", tmp_path / "new"] if command == "render" else [])], says, run)
    assert "own_window" not in sys.modules
    assert main(["evaluate", str(run), "--task", "own_window:TASK", *EVALUATE]) == 0
    assert main(["evaluate", str(run), *EVALUATE]) == 0  # known to this process now


def test_a_scenario_is_the_ground_for_options(run, tmp_path):
    worlds = []
    for number, option in enumerate(([], ["--scenario", "narrow"], ["--task.half-width-deg", "9"])):
        out = tmp_path / f"{number}.json"
        given = [*option, *(["--scenario=narrow"] if number == 2 else [])]
        assert main(["evaluate", "--task=own_window:TASK", *EVALUATE, *given, "--out", str(out)]) == 0
        worlds.append(json.loads(out.read_text()))
    assert [world["world"]["half_width_deg"] for world in worlds] == [28.0, 5.0, 9.0]
    assert [world.get("scenario") for world in worlds] == [None, "narrow", "narrow"]
    assert [world["subject"] for world in worlds] == ["window"] * 3


def test_a_policy_of_code_is_measured_in_a_task(refused, capsys, tmp_path):
    measure = ["--task", "own_window:TASK", *EVALUATE[2:]]
    assert main(["evaluate", "own_window:ahead", *measure, "--compare", "uniform"]) == 0
    assert "own, 20 steps a lane" in " ".join(capsys.readouterr().out.split())
    refused(["evaluate", *measure, "--policy", "own"], "policy 'own' is code: name it first", tmp_path)


def test_what_cannot_be_is_refused(run, forget, refused, tmp_path):
    new = ["--out", tmp_path / "new"]
    refused(["render", "own_window:TASK", "--policy", "uniform", *new], "window has no pictures of point", tmp_path)
    refused(["train", "own_window:MUTE", "--guidance", "relative", *new], "mute has no teacher to ask", tmp_path)
    forget()
    refused(["evaluate", run, "--task", "own_window:MUTE"], "add --task own_window:TASK", run)
    registry.resolve("own_window:TASK")
    refused(["evaluate", run, "--task", "own_window:MUTE"], "is a run of window, not of mute: give one of mute", run)
