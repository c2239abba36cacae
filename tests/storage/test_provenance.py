"""Provenance: what every recorded number says of its origin."""

import subprocess
import sys
from pathlib import Path

import cuelearner_jax
from cuelearner_jax.storage.provenance import provenance

ROOT = Path(cuelearner_jax.__file__).resolve().parents[1]


def test_the_command_can_be_given_again(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/some/where/cuelearner", "sweep", "a task", "--seeds", "2"])
    columns = provenance()
    assert columns["command"] == "cuelearner sweep 'a task' --seeds 2"
    assert columns["versions"].startswith(f"python {sys.version.split()[0]}, ")
    assert "jax 0." in columns["versions"]
    assert columns["hardware"]


def test_the_commit_is_that_of_the_checkout_or_empty():
    commit = provenance()["commit"].removesuffix("-dirty")
    if not (ROOT / ".git").exists():
        assert commit == ""
        return
    head = subprocess.run(["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout
    assert len(commit) == 12
    assert head.startswith(commit)
