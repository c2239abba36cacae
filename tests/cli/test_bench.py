"""The command `cuelearner bench`, on networks so small that it takes seconds."""

import json
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from cuelearner_jax.cli import bench, main

SMALL = ["bench", "billiards", "--preset", "quickstart", "--seconds", "0.01", "--agent.q-layers", "16"]
SMALL += ["--agent.directions", "36", "--agent.replay-capacity", "1000"]


def test_it_prints_figures_and_writes_them_once(refused, tmp_path, capsys):
    out = tmp_path / "entry.json"
    assert main([*SMALL, "--seeds", "2", "--out", str(out)]) == 0
    told = capsys.readouterr()
    lines = told.out.splitlines()
    assert lines[0].split()[:4] == ["task", "preset", "seeds", "steps/s"]
    assert lines[1].split()[:3] == ["billiards", "quickstart", "2"]
    written = json.loads(out.read_text())
    assert written["command"] == " ".join(["cuelearner", *SMALL, "--seeds", "2", "--out", str(out)])
    assert written["rows"][0]["seeds"] == 2
    refused([*SMALL, "--seeds", "1", "--out", out], "give another --out", tmp_path)


BAD = [
    ([*SMALL, "--seeds", "0"], "different positive numbers"),
    ([*SMALL, "--seeds", "2", "2"], "different positive numbers"),
    ([*SMALL, "--seconds", "0"], "--seconds is 0.0"),
    ([*SMALL, "--devices", "9"], "--devices is 9: give at most"),
    ([*SMALL, "--agent.replay-capacity", "1000000000000"], "counted in 32 bits"),
    (["bench", "billards"], "did you mean 'billiards'"),
    (["bench", "--seedz", "1"], "--seeds"),
]


@pytest.mark.parametrize(("command", "says"), BAD, ids=[" ".join(command)[-30:] for command, _ in BAD])
def test_what_cannot_be_measured_is_refused(refused, tmp_path, command, says):
    refused(command, says, tmp_path)


def test_ctrl_c_stops_it_with_no_file(tmp_path, monkeypatch, capsys):
    @contextmanager
    def interruptible():
        yield SimpleNamespace(is_set=lambda: True)

    monkeypatch.setattr(bench, "interruptible", interruptible)
    assert main([*SMALL, "--seeds", "2", "--out", str(tmp_path / "entry.json")]) == 130
    assert "stopped after 0 of 1 measurements; nothing was written" in capsys.readouterr().err
    assert not (tmp_path / "entry.json").exists()
