"""`cuelearner label` and `cuelearner labels`: the real command, what it refuses, and what takes its files."""

import dataclasses
import shlex
import signal
import socket
import time
import urllib.error
import urllib.request
from pathlib import Path

import probes
import pytest
import recorded_situations as recorded
from sessions import OWN, expert, plan, served

from cuelearner_jax.cli import label, main
from cuelearner_jax.labelling.session import Session
from cuelearner_jax.storage import label_files
from cuelearner_jax.tasks import registry as tasks

ROOT = Path(__file__).resolve().parents[2]
POLICY = [str(ROOT / "docs" / "data" / "navigation_agent")]


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """Folders of two people's labels of the same questions, one of another seed; nobody writes there."""
    folder = tmp_path_factory.mktemp("labelled")
    for name, seed, turn in (("one", 0, 1.0), ("two", 3, -1.0)):
        with Session(plan(seed=seed, who=name), folder / name) as session:
            for number in range(12):
                session.answer(number, turn * expert(session.item), seconds=0.0)
    return folder


def status_of(address, **headers):
    """What the page answers, to a request with these headers."""
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=20) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read().decode()


def test_the_page_is_served_to_who_knows_its_address_until_ctrl_c(tmp_path, refused, monkeypatch):
    """A browser is told a file that others cannot read."""
    pytest.importorskip("nicegui")
    browser, told, leads_there = tmp_path / "browser", tmp_path / "told", tmp_path / "labels/open.html"
    browser.write_text(f'#!/bin/sh\necho "$@" > {told}.new\nmv {told}.new {told}\n')
    browser.chmod(0o700)
    monkeypatch.setenv("BROWSER", str(browser))
    with served(tmp_path / "labels", "--open") as (process, address):
        place = address.partition("?")[0]
        assert place.startswith("http://127.0.0.1:")
        status, headers, text = status_of(address)
        assert status == 200
        assert "Which way should the middle arrow turn?" in text
        assert status_of(place, Cookie=headers["set-cookie"].partition(";")[0])[0] == 200
        for given in ({}, {"Cookie": "x=1"}, {"Host": "evil.example"}, {"Origin": "http://evil.example"}):
            assert status_of(address if given.keys() & {"Host", "Origin"} else place, **given)[0] == 403
        while not told.exists():
            time.sleep(0.05)
        assert told.read_text().split() == [leads_there.as_uri()]
        assert f"url={address}" in leads_there.read_text()
        assert leads_there.stat().st_mode & 0o777 == 0o600
        again = ["label", OWN, "--out", tmp_path / "labels"]
        refused(again, "is being written by another process", tmp_path / "labels")
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
        assert "every answer is in" in process.stderr.read()
    assert not leads_there.exists()
    assert [*(tmp_path / "labels").glob("labels*")] == []  # nothing was answered


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--labels", "0"], "--labels is 0: give a number from 1"),
        (["--guidance", "heuristic"], "guidance 'heuristic' asks for no labels: give --guidance relative or"),
        (["--sizes.candidates", "3", "--sizes.ensemble", "2"], "--sizes.candidates is above 1"),
        (["--again", "nothing"], "no label file at nothing"),
        (["--questions", "near_aims"], "--questions is near_aims, but wandering has no aims in this world"),
        (["--guidance", "reading"], "reading asks about a policy: name one after the task"),
    ],
)
def test_what_makes_no_sense_is_refused(more, says, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(["label", OWN, "--out", "labels", *more], says, tmp_path)


def test_a_port_in_use_is_refused_before_anything_is_made(refused, tmp_path):
    pytest.importorskip("nicegui")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        command = ["label", OWN, "--out", tmp_path / "labels", "--port", str(port)]
        refused(command, f"port {port} of 127.0.0.1 is not available", tmp_path)
    assert list(tmp_path.iterdir()) == []


def asked_for(monkeypatch, *arguments):
    """The options, plan and commands of a page that is not opened."""
    found = []

    def served(server, plan, asked, port, stopping, commands):
        found.extend([asked, plan, commands])
        return server.Ending("40 of 50 labels are saved", commands.following(40), commands.again)

    monkeypatch.setattr(label, "_serve", served)
    assert main(["label", *arguments]) == 0
    return found


def test_what_is_labelled_by_default_trains_in_minutes(monkeypatch, tmp_path, capsys):
    pytest.importorskip("nicegui")
    place = tmp_path / "my labels"
    asked, plan, commands = asked_for(monkeypatch, "billiards", "--out", str(place), "--who", "Ada B")
    preset = tasks.find("billiards").presets["quickstart"]
    assert (asked.task, asked.labels, plan.eps) == (preset.config.task, 100, preset.config.scalars.eps_deg)
    assert plan.base.name == "near_aims"
    assert commands.again == f"cuelearner label billiards --out '{place}' --who 'Ada B'"
    following = "cuelearner train billiards --preset quickstart --guidance relative --labels-from"
    assert commands.following(40) == f"{following} '{place}' --labels 40 --out 'runs/my labels'"
    told = capsys.readouterr().out
    assert "done: 40 of 50 labels are saved" in told
    assert f"next: {following}" in told


def test_a_second_opinion_is_asked_as_the_first_was(monkeypatch, tmp_path):
    pytest.importorskip("nicegui")
    weaker = dataclasses.replace(probes.CONFIG, scalars=dataclasses.replace(probes.SCALARS, eps_deg=7.0))
    with Session(plan(config=weaker), tmp_path / "one") as session:
        session.answer(0, expert(session.item))
    asked, second, _ = asked_for(monkeypatch, OWN, "--again", str(tmp_path / "one"), "--out", str(tmp_path / "two"))
    assert (asked.scalars.eps_deg, second.eps, len(second.again)) == (7.0, 7.0, 1)


def test_the_next_command_has_the_options_that_labels_depend_on(monkeypatch, tmp_path):
    pytest.importorskip("nicegui")
    monkeypatch.setattr(label, "make_plan", lambda *told: None)  # worlds take long to make
    options = ["--scenario", "corridor_left", "--sizes.frame", "action", "--scalars.eps-deg", "10"]
    _, _, commands = asked_for(monkeypatch, "navigation", "--out", str(tmp_path), *options)
    words = shlex.split(commands.following(7))
    assert words[:3] == ["cuelearner", "train", "navigation"]
    for pair in (["--task.style", "corridor"], ["--task.preferred-side", "left"], ["--scalars.eps-deg", "10.0"]):
        assert words[words.index(pair[0]) + 1] == pair[1]
    policy = [*POLICY, "--scenario", "turned_lidar", "--out", str(tmp_path)]
    asked, _, commands = asked_for(monkeypatch, "navigation", *policy, "--guidance", "relative")
    words = shlex.split(commands.following(7))
    assert words[:5] == ["cuelearner", "adapt", *POLICY, "--scenario", "turned_lidar"]
    assert "--task.lidar-rotation-deg" not in words
    assert asked.labels == 500
    asked, _, commands = asked_for(monkeypatch, "navigation", *policy, "--base.seed", "3", "--robot", "anymal")
    assert (asked.labels, asked.bound_deg, asked.scalars.eps_deg) == (100, None, 2.0)
    words = shlex.split(commands.following(7))
    for pair in (["--guidance", "reading"], ["--base.seed", "3"], ["--robot", "anymal"]):
        assert words[words.index(pair[0]) + 1] == pair[1]
    asked, *_ = asked_for(monkeypatch, "billiards", "shipped:billiards", "--scenario", "tilted_table")
    assert (asked.guidance, asked.bound_deg) == ("reading", 0.3)
    recorded.write(tmp_path / "seen", pictures=False)
    logged = [str(tmp_path / "seen"), "arm:policy", "--out", str(tmp_path / "labels")]  # whose labels hold the world
    _, _, commands = asked_for(monkeypatch, *logged)
    following = f"cuelearner adapt arm:policy --guidance reading --labels-from {tmp_path}/labels --labels 7"
    assert commands.following(7) == f"{following} --out policies/labels"
    _, _, commands = asked_for(monkeypatch, *logged, "--bound", "0.1")
    assert commands.following(7) == f"{following} --bound-deg 0.1 --out policies/labels"
    _, _, commands = asked_for(monkeypatch, "navigation", "--robot", "anymal", "--out", str(tmp_path))
    assert "--robot anymal" in commands.following(7)


def test_a_run_of_another_task_is_no_policy_here(run_folder, refused, tmp_path):
    refused(["label", OWN, run_folder, "--out", tmp_path / "labels"], "is a run of bandit, not of wandering", tmp_path)


def test_labels_are_inspected(labelled, capsys):
    assert main(["labels", "inspect", str(labelled / "one"), "--teacher"]) == 0
    told = capsys.readouterr().out
    for words in ("12", "relative, by 20 degrees", "one (12)", "100% of 12", "uniform"):
        assert words in told, told
    assert main(["labels", "inspect", str(labelled / "one"), str(labelled / "two")]) == 0
    assert "no labels to compare" in capsys.readouterr().out


def test_labels_are_merged(labelled, tmp_path, refused, capsys):
    both = tmp_path / "both.parquet"
    assert main(["labels", "merge", str(labelled / "one"), str(labelled / "two"), "--out", str(both)]) == 0
    assert label_files.read(both).people.who.tolist() == ["one"] * 12 + ["two"] * 12
    assert main(["labels", "inspect", str(both)]) == 0
    assert "not known" not in capsys.readouterr().out  # what does not stand is left out
    refused(["labels", "merge", labelled / "one", "--out", both], "both.parquet exists: give another --out", tmp_path)
    refused(["labels", "inspect", both, "--teacher"], "cannot be asked about this file", tmp_path)
    refused(["labels", "mend"], "Available subcommands: inspect, merge", tmp_path)
