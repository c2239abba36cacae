"""The command `cuelearner bench`, on networks so small that it takes seconds."""

import json
import signal
import subprocess
import sys
import time

import pytest

from cuelearner_jax.bench import known_machines as machines
from cuelearner_jax.cli import main

SMALL = ["bench", "billiards", "--preset", "quickstart", "--seconds", "0.01", "--sizes.q-layers", "16"]
SMALL += ["--sizes.directions", "36", "--sizes.replay-capacity", "1000"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    out = tmp_path_factory.mktemp("bench") / "entry.json"
    command = [
        sys.executable,
        "-m",
        "cuelearner_jax.cli",
        *SMALL,
        "--seeds",
        "2",
        "--name",
        "mine",
        "--out",
        str(out),
    ]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done, out


@pytest.mark.long
def test_it_says_what_it_does_and_prints_figures_beside_known_machines(measured):
    done, out = measured
    assert "MB a seed at rest" in done.stderr
    assert "measuring 1 times" in done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].split()[:4] == ["task", "preset", "seeds", "steps/s"]
    assert lines[1].split()[:3] == ["billiards", "quickstart*", "2"]
    assert "large matrix products, same run: float32" in done.stdout
    assert "known" in done.stdout
    assert lines[-1] == f"wrote {out}"


def test_its_file_is_an_entry_of_the_table_and_is_not_replaced(measured, refused, tmp_path):
    _, out = measured
    entry = json.loads(out.read_text())
    assert set(entry) == set(machines.ENTRY)
    assert (entry["name"], entry["rows"][0]["seeds"]) == ("mine", 2)
    assert entry["rows"][0]["changed"] == {
        "sizes.q_layers": [16],
        "sizes.directions": 36,
        "sizes.replay_capacity": 1000,
    }
    assert entry["command"] == " ".join(["cuelearner", *SMALL, "--seeds", "2", "--name", "mine"])  # no path in it
    refused([*SMALL, "--seeds", "1", "--out", out], "give another --out", out.parent)


BAD = [
    ([*SMALL, "--seeds", "0"], "different positive numbers"),
    ([*SMALL, "--seeds", "2", "2"], "different positive numbers"),
    ([*SMALL, "--seconds", "0"], "--seconds is 0.0"),
    ([*SMALL, "--devices", "9"], "--devices is 9: there are"),
    ([*SMALL, "--out", "nowhere/entry.json"], "make it first"),
    ([*SMALL, "--sizes.replay-capacity", "1000000000000"], "counted in 32 bits"),
    (["bench", "billards"], "did you mean 'billiards'"),
    (["bench", "billiards", "--preset", "papr"], "did you mean 'paper'"),
    (["bench", "--seedz", "1"], "--seeds"),
    (["bench", "--add", "nowhere.json"], "give a file that cuelearner bench --out wrote"),
]


@pytest.mark.parametrize(("command", "says"), BAD, ids=[" ".join(command)[-30:] for command, _ in BAD])
def test_what_cannot_be_measured_is_refused(refused, tmp_path, command, says):
    refused(command, says, tmp_path)


def test_a_damaged_measurement_stays_out_of_the_table(refused, tmp_path):
    (tmp_path / "entry.json").write_text('{"name": "mine"}')
    before = machines.TABLE.read_bytes()
    refused(["bench", "--add", tmp_path / "entry.json"], "is missing", tmp_path)
    assert machines.TABLE.read_bytes() == before


@pytest.mark.long
def test_ctrl_c_stops_it_with_what_was_measured_and_no_file(tmp_path):
    out = tmp_path / "entry.json"
    command = [sys.executable, "-m", "cuelearner_jax.cli", *SMALL, "--seeds", "2", "--seconds", "600"]
    process = subprocess.Popen([*command, "--out", str(out)], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if "measuring 1 times" in line:
            break
    time.sleep(2)
    process.send_signal(signal.SIGINT)
    try:
        told = process.communicate(timeout=60)[1]
    finally:
        process.kill()
    assert process.returncode == 130, told
    assert told.splitlines()[-1] == "stopped after 0 of 1 measurements; nothing was written"
    assert not out.exists()


def test_help_names_the_tasks(capsys):
    for command in (["bench", "--help"], ["bench", "billiards", "--help"]):
        with pytest.raises(SystemExit) as stop:
            main(command)
        assert stop.value.code == 0
        assert "--seconds" in capsys.readouterr().out
